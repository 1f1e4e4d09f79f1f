"""What a built dataset consists of, so that overwriting one deletes nothing else."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from pcdata.build.card import CARD_FILES
from pcdata.build.written_texts import FILE_NAME as TEXTS
from pcdata.build.written_texts import edited_texts
from pcdata.datasets.splits import FILE_NAME as SPLITS
from pcdata.errors import CacheError
from pcdata.io.store.left_out import FILES as LEFT_OUT_FILES
from pcdata.io.store.manifest import FILE_NAME, Manifest
from pcdata.io.store.sample_index import FILES as INDEX_FILES
from pcdata.io.store.sample_index import FOLDER as INDEX
from pcdata.io.store.sample_keys import key_of
from pcdata.io.store.shards import FOLDER as SHARDS
from pcdata.io.store.shards import SIGNALS_FOLDER, SIGNALS_KEY, TABLE, shard_folder
from pcdata.io.store.stores import STORES

_TOP = {FILE_NAME, "pipeline.yaml", "load.py", SPLITS, TEXTS, *CARD_FILES}
_LITTER = {"__pycache__", ".DS_Store", "Thumbs.db"}
_IN_VIEW = re.compile(  # what write_capture writes below raw/KEY of a shard
    r"|view[0-9]+(/intrinsics\.json|/depth(/0\.(png|npy))?|/(labels|masks|color|confidence)(/0\.png)?|/poses(/0\.txt)?)?"
)
_RAW = re.compile(rf"({SHARDS}/[0-9]+)/raw/([^/]+)(?:/(.+))?", re.DOTALL)
_SHOWN = 5


def check_only_dataset(folder: Path) -> None:
    """Require that a folder is a built dataset and holds nothing else.

    Raises:
        CacheError: deleting it would delete something that no build wrote; names it.
    """
    try:
        if not os.path.lexists(folder / FILE_NAME):
            raise CacheError(f"{folder} is not a pcdata dataset, so it is not overwritten; choose another folder")
        foreign = foreign_files(folder, _manifest_of(folder))
        foreign += [f"{name} (edited by hand)" for name in edited_texts(folder)]
    except OSError as error:
        raise CacheError(f"{folder}: cannot be examined: {error}") from error
    told_foreign(folder, foreign)


def told_foreign(place: object, foreign: Sequence[str]) -> None:
    """Refuse to overwrite a dataset that other files lie in, if there are any.

    Raises:
        CacheError: names them.
    """
    if foreign:
        more = f" and {len(foreign) - _SHOWN} more" if len(foreign) > _SHOWN else ""
        raise CacheError(
            f"{place} is a dataset but also holds {', '.join(foreign[:_SHOWN])}{more}, which overwriting would "
            "delete; move that out first, or choose another folder"
        )


def foreign_names(names: Iterable[str], folder: Path, manifest: Manifest) -> list[str]:
    """Return which of the files below a dataset, wherever that is, no build wrote; ``folder`` has its index."""
    known, raw = _known(folder, manifest, {})
    return sorted(
        name
        for name in names
        if not (name in known or _is_raw(name, raw) or any(part in _LITTER for part in name.split("/")))
    )


def _manifest_of(folder: Path) -> Manifest | None:
    """Return the manifest; None where nothing is left but itself and a part of its index."""
    try:
        return Manifest.read(folder)
    except CacheError:
        if Manifest.is_one(folder) and not foreign_files(folder, None):
            return None
        raise


def foreign_files(
    folder: Path, manifest: Manifest | None, tables: Mapping[int, Collection[str]] = MappingProxyType({})
) -> list[str]:
    """Return what no build wrote, below a dataset's folder.

    Without a manifest, of which a removal that was killed late leaves an index that is not whole, that is whatever lies
    beside it and the index. Of shards that have an entry in ``tables``, it is what is not named there.
    """
    known, raw = _known(folder, manifest, tables)
    folders = {parent.as_posix() for name in known for parent in Path(name).parents}
    folders |= {f"{shard}/raw" for shard in raw}
    foreign = []

    def refuse(error: OSError) -> None:
        raise error

    for place, names, files in os.walk(folder, onerror=refuse):
        relative = Path(place).relative_to(folder)
        names[:] = [name for name in names if name not in _LITTER]
        for name in names:
            path = (relative / name).as_posix()
            if os.path.islink(os.path.join(place, name)) or not (path in folders or _is_raw(path, raw)):
                foreign.append(path)
        names[:] = [name for name in names if (relative / name).as_posix() not in foreign]  # their name says enough
        for name in files:
            path = (relative / name).as_posix()
            if os.path.islink(os.path.join(place, name)) or not (path in known or _is_raw(path, raw)):
                foreign += [] if name in _LITTER else [path]
    return sorted(foreign)


def _known(
    folder: Path, manifest: Manifest | None, tables: Mapping[int, Collection[str]]
) -> tuple[set[str], dict[str, set[str]]]:
    """Return the files that a build writes, and of every shard the keys of the captures that may lie beside it."""
    known = _TOP | {f"{INDEX}/{name}" for name in (*INDEX_FILES, *LEFT_OUT_FILES)}
    raw: dict[str, set[str]] = {}
    if manifest is None:
        return known, raw
    for number in range(manifest.index.num_shards):
        shard = shard_folder(folder, number)
        if number in tables:
            known |= {(shard / name).relative_to(folder).as_posix() for name in tables[number]}
            continue
        store = STORES[manifest.format](shard)
        keys = {key_of(sample_id) for sample_id in manifest.index.ids[_as_slice(manifest.index.of_shard(number))]}
        raw[shard.relative_to(folder).as_posix()] = keys
        known |= {path.relative_to(folder).as_posix() for path in (shard / TABLE, *map(store.path_of, keys))}
    if "digest" in manifest.signals:
        path = STORES[manifest.format](folder / SIGNALS_FOLDER).path_of(SIGNALS_KEY)
        known.add(path.relative_to(folder).as_posix())
    return known, raw


def _as_slice(numbers: range) -> slice:
    return slice(numbers.start, numbers.stop)


def _is_raw(path: str, raw: Mapping[str, set[str]]) -> bool:
    found = _RAW.fullmatch(path)
    return found is not None and found[2] in raw.get(found[1], ()) and _IN_VIEW.fullmatch(found[3] or "") is not None
