"""``splits.json``: which samples of a dataset are for training and which are held out."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pcdata.errors import CacheError, ConfigError, locate, near_matches
from pcdata.files.opening import read_bytes, replacing
from pcdata.files.strict_json import json_object
from pcdata.io.store.manifest import checksum_of

FILE_NAME = "splits.json"

_SCHEMA = "pcdata.splits/1"
_CHECKSUM = "checksum"
_MAX_BYTES = 1 << 30
_SHOWN = 5

Groups = Mapping[str, Mapping[str, Sequence[str]]]  # split -> group -> sample ids


@dataclass(frozen=True)
class Splits:
    """The samples of every split, by groups that stand or fall together, such as scenes or episodes.

    Args:
        groups: split -> group -> ids of its samples.
        settings: how they were drawn; see :func:`pcdata.split_dataset`.
        absent: ids that had a split in an earlier build, and get it again where they come back.
    """

    groups: Groups
    settings: Mapping[str, Any] = field(default_factory=dict)
    absent: Sequence[str] = ()

    @property
    def names(self) -> list[str]:
        """The names of the splits."""
        return list(self.groups)

    def ids(self, split: str) -> list[str]:
        """Return the sample ids of a split, group by group, without absent ones.

        Raises:
            ConfigError: there is no such split.
        """
        if split not in self.groups:
            hint = near_matches(str(split), self.groups)
            raise ConfigError(f"there is no split {split!r:.100}{hint}; there are {', '.join(self.groups)}")
        absent = {*self.absent}
        return [one for ids in self.groups[split].values() for one in ids if one not in absent]

    def part_of(self) -> dict[str, str]:
        """Return the split of every sample id, of absent ones too."""
        return {one: split for split, groups in self.groups.items() for ids in groups.values() for one in ids}

    def rows(self, split: str, ids: Sequence[str]) -> list[int]:
        """Return the places of a split's samples among the ids of a dataset.

        Raises:
            ConfigError: there is no such split, or it has no sample.
        """
        chosen = {*self.ids(split)}
        if not chosen:
            raise ConfigError(f"the split {split!r} has no sample; take another, or draw the splits again: --fresh")
        return [place for place, sample_id in enumerate(ids) if sample_id in chosen]

    def write(self, path: Path) -> None:
        """Write the file, with a checksum of its contents; it replaces an old one at once, or not at all.

        Raises:
            CacheError: it cannot be written.
        """
        content = {
            "schema": _SCHEMA,
            "settings": dict(self.settings),
            "splits": {
                split: {group: list(ids) for group, ids in groups.items()} for split, groups in self.groups.items()
            },
            "absent": list(self.absent),
        }
        with (
            replacing("splits", path, error=CacheError) as temporary,
            open(temporary, "w", encoding="utf-8") as file,
        ):
            json.dump({**content, _CHECKSUM: checksum_of(content)}, file, indent=1, allow_nan=False)
            file.write("\n")
            file.flush()
            os.fsync(file.fileno())

    @classmethod
    def read(cls, path: str | Path, ids: Sequence[str] | None = None) -> Splits:
        """Read and check the file.

        Args:
            path: ``splits.json``, or the folder of a dataset that holds it.
            ids: of the dataset, each of which must be in one split; None = not known.

        Raises:
            CacheError: missing, damaged or edited, an id or a group in two splits, or not of these ids.
        """
        path = Path(path) / FILE_NAME if Path(path).is_dir() else Path(path)
        try:
            splits = cls._read(path)
            if ids is not None:
                splits.check_ids(ids)
            return splits
        except CacheError as error:
            located = error if str(error).startswith(("splits:", f"{path}")) else CacheError(f"{path}: {error}")
            locate(located, path=path)
            raise located from error

    @classmethod
    def _read(cls, path: Path) -> Splits:
        if not path.is_file():
            raise CacheError(f"{path}: there are no splits; draw them with 'pcdata split {path.parent}'")
        data = read_bytes("splits", path, max_bytes=_MAX_BYTES, error=CacheError)
        content = json_object(f"{path}", data, error=CacheError)
        if content.get("schema") != _SCHEMA:
            raise CacheError(f"schema must be {_SCHEMA!r}, got {content.get('schema')!r:.100}; draw the splits again")
        found = content.pop(_CHECKSUM, None)
        if set(content) != {"schema", "settings", "splits", "absent"}:
            raise CacheError(f"must have schema, settings, splits, absent and checksum, got {sorted(content)!r:.200}")
        if found != checksum_of(content):
            raise CacheError(
                "was changed after it was written: its checksum does not fit its contents; copy it again, or draw "
                "the splits again, which may be named by a table: --named-by column:NAME"
            )
        settings, groups, absent = content["settings"], content["splits"], content["absent"]
        is_right = isinstance(settings, dict) and _is_texts(absent) and isinstance(groups, dict) and groups
        if not is_right or not all(
            isinstance(one, dict) and all(map(_is_texts, one.values())) for one in groups.values()
        ):
            raise CacheError("splits must map names to groups of sample ids, settings names to values")
        splits = cls(groups, settings, absent)
        _check_once("sample", [one for group in groups.values() for ids in group.values() for one in ids])
        _check_once("group", [name for group in groups.values() for name in group])
        return splits

    def check_ids(self, ids: Sequence[str]) -> None:
        """Require that the splits are of the samples of a dataset: each in one, and no other but absent ones.

        Raises:
            CacheError: names those that are in none, or are not of the dataset.
        """
        known, own = self.part_of(), {*ids}
        if left := [one for one in ids if one not in known]:
            raise CacheError(
                f"{_some(left)} of the dataset {'are' if len(left) > 1 else 'is'} in no split; 'pcdata split DATASET' "
                "adds what is new and moves nothing"
            )
        if strange := sorted(known.keys() - own - {*self.absent}):
            raise CacheError(
                f"{_some(strange)} {'are' if len(strange) > 1 else 'is'} not of the dataset: are these the splits of "
                "another one? 'pcdata split DATASET' keeps them as absent"
            )
        if wrong := sorted({*self.absent} - known.keys()):
            raise CacheError(f"{_some(wrong)} called absent had no split")


def _check_once(noun: str, names: Sequence[str]) -> None:
    if len(set(names)) != len(names):
        seen: set[str] = set()
        twice = next(one for one in names if one in seen or seen.add(one))  # type: ignore[func-returns-value]
        raise CacheError(f"the {noun} {twice!r:.100} comes twice; draw the splits again")


def _some(ids: Sequence[str]) -> str:
    shown = ", ".join(repr(one)[:100] for one in ids[:_SHOWN])
    more = f" and {len(ids) - _SHOWN} more" if len(ids) > _SHOWN else ""
    return f"{'samples' if len(ids) > 1 else 'the sample'} {shown}{more}"


def _is_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(one, str) for one in value)
