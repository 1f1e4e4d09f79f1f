"""``dataset.json``: what a built dataset holds and which pipeline made it."""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pcdata.errors import CacheError, PcdataWarning, locate
from pcdata.files.opening import read_bytes
from pcdata.files.scratch import retired_of
from pcdata.files.whole_folders import DATASET
from pcdata.io.store.cloud_record import parse_info
from pcdata.io.store.stores import STORES, Compression
from pcdata.structures import Episode
from pcdata.structures.episodes import episodes_from_json

SCHEMA = "pcdata.dataset/1"
FILE_NAME = DATASET
SIGNALS_KEY = "~signals"  # of the record of the signals of all samples; no sample has a key that begins so

_CHECKSUM = "checksum"
_MAX_BYTES = 256 * 2**20  # about a million samples
_DEFINED = ("transforms", "layouts", "combinators")  # what a file of one's own may define
_MAX_KEY = 200  # file names end at 255 bytes


@dataclass(frozen=True)
class Sample:
    """One stored sample: its id, the key it is stored under, its size and the digest of its record."""

    id: str
    key: str
    num_points: int
    digest: str


@dataclass(frozen=True)
class Manifest:
    """The contents of ``dataset.json``."""

    format: str
    compression: Compression
    fingerprint: str  # of the deterministic steps that made the stored clouds
    pipeline: Mapping[str, Any]  # section -> list of {transform: fields}
    samples: Sequence[Sample]
    versions: Mapping[str, str] = field(default_factory=dict)
    skipped: Mapping[str, str] = field(default_factory=dict)  # id of a capture that was left out -> why
    model: Mapping[str, Any] = field(default_factory=dict)  # name and choices of the model that it was built for
    source: Mapping[str, Any] = field(default_factory=dict)  # the section source that it was built with; {} = unknown
    imports: Sequence[
        Mapping[str, Any]
    ] = ()  # files with steps or the reader that were used: name, hash, what is in it
    episodes: Sequence[Episode] = ()  # over the samples
    signals: Mapping[str, str] = field(default_factory=dict)  # "digest" of the record of all, or the "fault" they have
    streams: Sequence[Mapping[str, Any]] = ()  # of the recordings: how each was joined, and what that left
    schema: str = SCHEMA

    def write(self, folder: Path) -> None:
        """Write the file, with a checksum of its own contents, and force it to disk."""
        content = asdict(self)
        with open(folder / FILE_NAME, "x", encoding="utf-8") as file:
            json.dump({**content, _CHECKSUM: checksum_of(content)}, file, indent=1, allow_nan=False)
            file.write("\n")
            file.flush()
            os.fsync(file.fileno())

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
    def _read(cls, folder: str | Path, path: Path) -> Manifest:
        if not path.is_file():
            if not os.path.lexists(folder) and (retired := retired_of(Path(os.path.realpath(folder)))):
                raise CacheError(
                    f"{folder}: is missing, since an overwrite of it was killed: the old one is {retired[0]}; "
                    "rename it back, or build again"
                )
            raise CacheError(f"{folder}: not a pcdata dataset: it has no {FILE_NAME}; make one with 'pcdata build'")
        text = read_bytes("dataset", path, max_bytes=_MAX_BYTES, error=CacheError)
        try:
            content = parse_info(text)
            if content.get("schema") != SCHEMA:
                raise CacheError(f"schema must be {SCHEMA!r}, got {content.get('schema')!r:.100}; rebuild the dataset")
            found = content.pop(_CHECKSUM, None)
            listed: dict[str, Any] = {"samples": [Sample(**sample) for sample in content["samples"]]}
            if isinstance(content.get("imports"), list):
                listed["imports"] = tuple(content["imports"])
            if isinstance(content.get("streams"), list):
                listed["streams"] = tuple(content["streams"])
            if "episodes" in content:
                count = len(listed["samples"])
                listed["episodes"] = tuple(
                    episodes_from_json("the dataset", content["episodes"], count, error=CacheError)
                )
            manifest = cls(**{**content, **listed})
            _check(manifest)
            if found is not None and found != checksum_of(content):
                raise CacheError(
                    "was changed after it was written: its checksum does not fit its contents; copy it again from "
                    "where the dataset was built, or rebuild the dataset"
                )
        except CacheError as error:
            raise CacheError(f"{path}: {error}") from error
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
        ("pipeline", dict),
        ("versions", dict),
        ("skipped", dict),
        ("model", dict),
        ("source", dict),
        ("signals", dict),
    ):
        if not isinstance(getattr(manifest, name), kind):
            raise CacheError(f"{name} must be a {kind.__name__}, got {getattr(manifest, name)!r:.100}")
    if manifest.model and not (isinstance(manifest.model.get("name"), str) and _is_choices(manifest.model)):
        raise CacheError(f"model must have a name and choices, got {manifest.model!r:.100}")
    if not isinstance(manifest.imports, tuple) or not all(map(_is_import, manifest.imports)):
        raise CacheError(f"imports must list files with their sha256 and names, got {manifest.imports!r:.100}")
    if set(manifest.signals) - {"digest", "fault"} or not all(isinstance(t, str) for t in manifest.signals.values()):
        raise CacheError(f"signals must have a digest or a fault, got {manifest.signals!r:.100}")
    if not isinstance(manifest.streams, tuple) or not all(isinstance(one, dict) for one in manifest.streams):
        raise CacheError(f"streams must list objects, got {manifest.streams!r:.100}")
    if not manifest.samples:
        raise CacheError("it lists no samples; rebuild the dataset")
    for sample in manifest.samples:
        texts = (sample.id, sample.key, sample.digest)
        if not all(isinstance(text, str) for text in texts) or type(sample.num_points) is not int:
            raise CacheError(f"a sample needs an id, a key, num_points and a digest, got {sample!r:.200}")
    if len({sample.key for sample in manifest.samples}) != len(manifest.samples):
        raise CacheError("two samples share a key")
    for sample in manifest.samples:
        # Keys become file names: one that could climb out of the folder is refused.
        if sample.key != key_of(sample.id):
            raise CacheError(f"sample {sample.id!r} must have the key {key_of(sample.id)!r}, got {sample.key!r}")


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


def key_of(sample_id: str) -> str:
    """Return a file-name safe and unique key for a sample id.

    Letters, digits, dot, dash and underscore stay; other bytes become %XX; a leading dot too. A key too long for a file
    name ends in ``~`` and a hash instead.

    Raises:
        CacheError: the id is empty, or no text in one line.
    """
    if not isinstance(sample_id, str) or sample_id.splitlines() != [sample_id]:
        raise CacheError(f"a sample id must be a text in one line that is not empty, got {sample_id!r:.100}")
    # surrogatepass: file names that are not UTF-8 reach Python as lone surrogates.
    key = quote(sample_id, safe="", errors="surrogatepass").replace("~", "%7E")
    key = "%2E" + key[1:] if key.startswith(".") else key
    if len(key) > _MAX_KEY:
        digest = hashlib.sha256(key.encode()).hexdigest()[:32]
        key = f"{key[: _MAX_KEY - 33]}~{digest}"
    return key
