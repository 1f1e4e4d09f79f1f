"""``dataset.json``: what a built dataset holds and which pipeline made it."""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from pcdata.errors import CacheError, PcdataWarning, locate
from pcdata.files.opening import read_bytes
from pcdata.files.scratch import retired_of
from pcdata.files.urls import url_hint
from pcdata.files.whole_folders import DATASET
from pcdata.io.store.cloud_record import parse_info
from pcdata.io.store.sample_index import Sample, SampleIndex, written
from pcdata.io.store.shards import SIGNALS_FOLDER, hashes_below, read_tables
from pcdata.io.store.stores import STORES, Compression
from pcdata.structures import Episode
from pcdata.structures.episodes import episodes_from_json

SCHEMA = "pcdata.dataset/2"
FILE_NAME = DATASET

_CHECKSUM = "checksum"
_MAX_BYTES = 256 * 2**20  # a million episodes
KINDS, MOST_IN_JSON = ("skipped", "quarantined"), 1000  # of captures that are left out; more lie in arrays
_DEFINED = ("transforms", "layouts", "combinators")  # what a file of one's own may define


@dataclass(frozen=True)
class Manifest:
    """The contents of ``dataset.json``, and the index of the samples beside it."""

    format: str
    compression: Compression
    fingerprint: str  # of the deterministic steps that made the stored clouds
    pipeline: Mapping[str, Any]  # section -> list of {transform: fields}
    samples: SampleIndex | Sequence[Sample]  # an index afterwards
    identity: str = ""  # of the build: SHA-256 of its settings, its captures' ids and how they were read
    versions: Mapping[str, str] = field(default_factory=dict)
    keep_raw: bool = False  # whether the captures lie beside the clouds
    compact: bool = False  # whether colors are bytes and normals two numbers: see compact_fields
    shard_size: int | None = None  # what was asked for; None = what fits the number of captures
    skipped: Mapping[str, str] = field(default_factory=dict)  # id of a capture that was left out -> why
    quarantined: Mapping[str, str] = field(default_factory=dict)  # id of a capture that failed twice -> why
    model: Mapping[str, Any] = field(default_factory=dict)  # name and choices of the model that it was built for
    source: Mapping[str, Any] = field(default_factory=dict)  # the section source that it was built with; {} = unknown
    imports: Sequence[
        Mapping[str, Any]
    ] = ()  # files with steps or the reader that were used: name, hash, what is in it
    episodes: Sequence[Episode] = ()  # over the samples
    signals: Mapping[str, str] = field(default_factory=dict)  # "digest" of the record of all, or the "fault" they have
    signals_files: Mapping[str, Any] = field(default_factory=dict)  # bytes and sha256 of each; filled in when written
    streams: Sequence[Mapping[str, Any]] = ()  # of the recordings: how each was joined, and what that left
    steps: Sequence[Mapping[str, Any]] = ()  # points after each step, over all samples: see step_statistics
    origins: Sequence[Mapping[str, Any]] = ()  # what the captures say of sensor, depth and frames: see build.origins
    alarms: Sequence[Mapping[str, Any]] = ()  # steps that drop too much, and captures that are outliers of the rest
    schema: str = SCHEMA

    def __post_init__(self) -> None:
        object.__setattr__(self, "samples", SampleIndex.of(self.samples))

    @property
    def index(self) -> SampleIndex:
        """The samples, as their index."""
        assert isinstance(self.samples, SampleIndex)
        return self.samples

    def write(self, folder: Path) -> None:
        """Write the index and the file, with a checksum of its own contents, and force them to disk.

        The shards are there already, each closed by :func:`~pcdata.io.store.shards.seal_shard`.

        Raises:
            CacheError: a shard is missing, or not closed.
            OSError: the disk is full.
        """
        content = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "samples"}
        content["episodes"] = [asdict(episode) for episode in self.episodes]
        content["num_samples"] = len(self.index)
        content["signals_files"] = hashes_below(folder / SIGNALS_FOLDER)
        content["index"] = self.index.write(folder, read_tables(folder))
        for kind in KINDS:
            if len(content[kind]) > MOST_IN_JSON:
                from pcdata.io.store.left_out import write_left_out

                content[kind] = write_left_out(folder, kind, content[kind])
        text = json.dumps({**content, _CHECKSUM: checksum_of(content)}, indent=1, allow_nan=False) + "\n"
        if len(text) > _MAX_BYTES:
            largest = max(content, key=lambda name: len(json.dumps(content[name])))
            raise CacheError(
                f"{folder / FILE_NAME}: would have {len(text):,} bytes, most of them its {largest}, and at most "
                f"{_MAX_BYTES:,} are read; build fewer captures into one dataset"
            )
        written(folder / FILE_NAME, text.encode())

    @classmethod
    def read(cls, folder: str | Path) -> Manifest:
        """Read and check the file.

        Raises:
            CacheError: missing, damaged, hostile, or of another schema.
        """
        path = Path(folder) / FILE_NAME
        try:
            return cls._read(folder, path)
        except CacheError as error:
            locate(error, path=path)
            raise

    @classmethod
    def is_one(cls, folder: Path) -> bool:
        """Say whether a folder's ``dataset.json`` is what a build wrote, whatever became of its index."""
        try:
            content = parse_info(read_bytes("dataset", folder / FILE_NAME, max_bytes=_MAX_BYTES, error=CacheError))
        except CacheError:
            return False
        return content.pop(_CHECKSUM, None) == checksum_of(content) and content.get("schema") == SCHEMA

    @classmethod
    def _read(cls, folder: str | Path, path: Path) -> Manifest:
        if not path.is_file():
            if not os.path.lexists(folder) and (retired := retired_of(Path(os.path.realpath(folder)))):
                raise CacheError(
                    f"{folder}: is missing, since an overwrite of it was killed: the old one is {retired[0]}; "
                    "rename it back, or build again"
                )
            if hint := url_hint(folder):
                raise CacheError(hint)
            raise CacheError(f"{folder}: not a pcdata dataset: it has no {FILE_NAME}; make one with 'pcdata build'")
        text = read_bytes("dataset", path, max_bytes=_MAX_BYTES, error=CacheError)
        try:
            content = parse_info(text)
            if content.get("schema") != SCHEMA:
                raise CacheError(f"schema must be {SCHEMA!r}, got {content.get('schema')!r:.100}; rebuild the dataset")
            found = content.pop(_CHECKSUM, None)
            if found is not None and found != checksum_of(content):
                raise CacheError(
                    "was changed after it was written: its checksum does not fit its contents; copy it again from "
                    "where the dataset was built, or rebuild the dataset"
                )
            samples = SampleIndex.read(Path(folder), content.pop("index"), content.pop("num_samples"))
            listed: dict[str, Any] = {"samples": samples}
            for name in ("imports", "streams", "steps", "origins", "alarms"):
                if isinstance(content.get(name), list):
                    listed[name] = tuple(content.pop(name))
            for kind in KINDS:
                told = content.get(kind)
                if isinstance(told, dict) and not {*map(type, told.values())} <= {str}:
                    from pcdata.io.store.left_out import LeftOut  # of many: most datasets have none

                    content[kind] = LeftOut(Path(os.path.abspath(folder)), kind, told)
            if "episodes" in content:
                listed["episodes"] = tuple(
                    episodes_from_json("the dataset", content.pop("episodes"), len(samples), error=CacheError)
                )
            manifest = cls(**content, **listed)
            _check(manifest)
        except CacheError as error:
            told = CacheError(f"{path}: {error}")
            locate(told, path=getattr(error, "path", None))  # of the index, where it is at fault
            raise told from error
        except (TypeError, ValueError, KeyError, OverflowError, RecursionError, MemoryError) as error:
            kind = type(error).__name__
            raise CacheError(f"{path}: cannot be read ({kind}: {error!s:.500}); rebuild the dataset") from error
        if found is None:
            warnings.warn(
                f"{path}: has no checksum, which every build writes, so it was made or changed by other means, and "
                "edits cannot be told; rebuild the dataset to have one",
                PcdataWarning,
                stacklevel=3,
            )
        return manifest


def checksum_of(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a manifest's contents as canonical JSON, without the checksum itself."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _check(manifest: Manifest) -> None:
    if manifest.format not in STORES:
        raise CacheError(
            f"format must be one of {', '.join(STORES)}, got {manifest.format!r:.100}; one of your own needs "
            "--import FILE.py"
        )
    if manifest.compression not in STORES[manifest.format].compressions:
        raise CacheError(f"compression {manifest.compression!r:.100} does not exist for format {manifest.format}")
    for name, kind in (
        ("fingerprint", str),
        ("identity", str),
        ("pipeline", dict),
        ("versions", dict),
        ("skipped", Mapping),
        ("quarantined", Mapping),
        ("model", dict),
        ("source", dict),
        ("signals", dict),
        ("signals_files", dict),
    ):
        if not isinstance(getattr(manifest, name), kind):
            raise CacheError(f"{name} must be a {kind.__name__}, got {getattr(manifest, name)!r:.100}")
    for name in ("keep_raw", "compact"):
        if type(getattr(manifest, name)) is not bool:
            raise CacheError(f"{name} must be true or false, got {getattr(manifest, name)!r:.100}")
    if manifest.shard_size is not None and (type(manifest.shard_size) is not int or manifest.shard_size < 1):
        raise CacheError(f"shard_size must be a whole number from 1, or null, got {manifest.shard_size!r:.100}")
    if manifest.model and not (isinstance(manifest.model.get("name"), str) and _is_choices(manifest.model)):
        raise CacheError(f"model must have a name and choices, got {manifest.model!r:.100}")
    if not isinstance(manifest.imports, tuple) or not all(map(_is_import, manifest.imports)):
        raise CacheError(f"imports must list files with their sha256 and names, got {manifest.imports!r:.100}")
    if set(manifest.signals) - {"digest", "fault"} or not all(isinstance(t, str) for t in manifest.signals.values()):
        raise CacheError(f"signals must have a digest or a fault, got {manifest.signals!r:.100}")
    if not all(isinstance(told, dict) and set(told) == {"bytes", "sha256"} for told in manifest.signals_files.values()):
        raise CacheError(f"signals_files must give bytes and sha256 of each, got {manifest.signals_files!r:.100}")
    for name in ("streams", "steps", "origins", "alarms"):
        entries = getattr(manifest, name)
        if not isinstance(entries, tuple) or not all(isinstance(one, dict) for one in entries):
            raise CacheError(f"{name} must list objects, got {entries!r:.100}")


def _is_import(entry: Any) -> bool:
    """Say whether an entry is as :meth:`pcdata.imports.ImportedFile.to_json` writes it."""
    if not isinstance(entry, dict) or set(entry) != {"file", "sha256", *_DEFINED}:
        return False
    names = [entry["file"], entry["sha256"]]
    for listed in (entry[kind] for kind in _DEFINED):
        names += listed if isinstance(listed, list) else [None]
    return all(isinstance(name, str) for name in names)


def _is_choices(model: Mapping[str, Any]) -> bool:
    return set(model) == {"name", "choices"} and isinstance(model["choices"], dict)
