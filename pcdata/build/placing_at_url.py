"""How a dataset gets its URL, where nothing can be renamed: copied by the store, ``dataset.json`` last.

Each step may be done again, by another process too. ``placing.json`` beside the plan of the unfinished build says that
it has begun, and what of an old dataset is to be deleted. Without ``dataset.json`` there is no dataset.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from pcdata.build.building import SHARD, SHARDS
from pcdata.build.contents import foreign_names, told_foreign
from pcdata.build.plan import json_bytes
from pcdata.build.records import ShardRecord
from pcdata.errors import CacheError
from pcdata.files.scratch import Note
from pcdata.files.strict_json import json_object
from pcdata.files.url_writing import WritableUrl, is_missing
from pcdata.io.store.left_out import FILES as LEFT_OUT_FILES
from pcdata.io.store.manifest import FILE_NAME as DATASET
from pcdata.io.store.manifest import Manifest
from pcdata.io.store.sample_index import FILES as INDEX_FILES
from pcdata.io.store.sample_index import FOLDER as INDEX
from pcdata.io.store.shards import shard_folder

PLACING = "placing.json"
MOST_BYTES = 1 << 32  # of a list of files


class PlacingAtUrl:
    """What is at the URL of a dataset, and how a finished build gets there.

    Args:
        target: the URL.
        kept_at: of the unfinished build.
    """

    def __init__(self, target: WritableUrl, kept_at: WritableUrl) -> None:
        self.target = target
        self.kept_at = kept_at

    def run(
        self, dataset: Path, identity: str, records: Mapping[int, ShardRecord], replaced: object, note: Note
    ) -> None:
        """Let the store hold the dataset at its URL.

        Args:
            dataset: the folder of the files that no shard has.
            identity: of the build.
            records: of all its shards, which are in the unfinished build.
            replaced: what :meth:`state` was before.
            note: told where another process did it.

        Raises:
            CacheError: something else is there now, or it cannot be put there.
        """
        shards = {
            (shard_folder(Path(), shard) / name).as_posix(): (f"{SHARDS}/{record.folder_name}/{SHARD}/{name}", size)
            for shard, record in records.items()
            for name, size in record.files.items()
        }
        files = {path.relative_to(dataset).as_posix(): path for path in dataset.rglob("*") if path.is_file()}
        files = {name: path for name, path in files.items() if name not in shards and not name.startswith("shards/")}
        sizes = {name: size for name, (_, size) in shards.items()}
        sizes.update({name: path.stat().st_size for name, path in files.items() if name != DATASET})
        if self.identity() == identity and self.state() != replaced:
            note("another process put the dataset into place")
        else:
            gone = self._begin({*sizes, DATASET}, replaced)
            self.target.remove([DATASET])
            try:
                self.target.copy(self.kept_at, {name: there for name, (there, _) in shards.items()})
            except CacheError as error:  # another process has put it into place, and removed what it needs no more
                there = self.target.sizes()
                if not is_missing(error) or any(there.get(name) != size for name, (_, size) in shards.items()):
                    raise
            self.target.put({name: path for name, path in files.items() if name != DATASET})
            self.target.remove(gone)
            there = self.target.sizes()
            if wrong := [name for name, size in sizes.items() if there.get(name) != size]:
                raise CacheError(
                    f"{self.target}: {wrong[0]} has {there.get(wrong[0], 'no')} bytes, but {sizes[wrong[0]]} were put "
                    f"there; does something else write to {self.target}? The same command puts it there again"
                )
            self.target.put({DATASET: files[DATASET]})

    def _begin(self, names: set[str], replaced: object) -> list[str]:
        """Say that the dataset is being put under its name; return which files of an old one are in its way."""
        placing = self.begun()
        if placing is None:
            sizes = self.target.sizes()
            if sizes and (replaced is None or self.state() != replaced):
                raise CacheError(
                    f"{self.target}: somebody else made or changed it while this was built, so it is left as it is; "
                    "choose another URL"
                )
            if sizes:
                with tempfile.TemporaryDirectory(prefix="pcdata-") as folder:
                    told_foreign(self.target, foreign_names(sizes, Path(folder), self.manifest(Path(folder))))
            placing = sorted({*sizes} - names)
            self.kept_at.write(PLACING, json_bytes({"gone": placing}))
        return [name for name in placing if name not in names]

    def begun(self) -> list[str] | None:
        """Return what a build that was stopped while it put a dataset into place was about to delete; None = none."""
        text = self.kept_at.read_each([PLACING], max_bytes=MOST_BYTES).get(PLACING)
        if text is None:
            return None
        gone = json_object(f"{self.kept_at}/{PLACING}", text, error=CacheError).get("gone")
        return [name for name in gone if isinstance(name, str)] if isinstance(gone, list) else []

    def manifest(self, folder: Path) -> Manifest:
        """Return the manifest of the dataset that is there, whose small files are fetched to a folder."""
        try:
            there = self.target.sizes()
            left_out = [name for name in (f"{INDEX}/{one}" for one in LEFT_OUT_FILES) if name in there]
            names = [DATASET, *(f"{INDEX}/{one}" for one in INDEX_FILES), *left_out]
            self.target.fetch({name: folder / name for name in names})
            return Manifest.read(folder)
        except CacheError as error:
            words = str(error).replace(str(folder), str(self.target))
            raise CacheError(f"{self.target}: what is there cannot be told, so it is left as it is: {words}") from error

    def state(self) -> str | None:
        """Return what tells the dataset that is there from another; None = there is none."""
        text = self.target.read_each([DATASET], max_bytes=MOST_BYTES).get(DATASET)
        return None if text is None else hashlib.sha256(text).hexdigest()

    def identity(self) -> str | None:
        """Return the identity of the build that the dataset there is of; None = there is none that can be told."""
        text = self.target.read_each([DATASET], max_bytes=MOST_BYTES).get(DATASET)
        with suppress(CacheError):
            told = None if text is None else json_object(DATASET, text, error=CacheError).get("identity")
            return told if isinstance(told, str) else None
        return None
