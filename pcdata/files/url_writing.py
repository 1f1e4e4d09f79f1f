"""Folders behind a URL that are written to: files are put, copied, listed and deleted as a whole, several at a time.

An object store has no folders, no rename and no lock: what it promises is that one file appears at once, or not at all.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from pcdata.errors import CacheError, ConfigError, PcdataError
from pcdata.files.urls import UrlFolder

_AT_ONCE = 16  # files on their way, where a file system takes several


def is_missing(error: PcdataError) -> bool:
    """Say whether a file could not be had because there is none."""
    return isinstance(error.__cause__, FileNotFoundError)


class WritableUrl(UrlFolder):
    """The files below a URL, to be read and written.

    Args:
        where: who asks, the first words of a message.
        url: of the folder; it needs a name in its bucket or file system.

    Raises:
        ConfigError: nobody knows this kind of URL, or it names no folder.
        MissingExtraError: its package is not installed.
    """

    def __init__(self, where: str, url: str) -> None:
        super().__init__(where, url, error=CacheError)
        files, root = self.opened()
        has_buckets = getattr(files, "async_impl", False)
        if not self.name or root.strip("/").count("/") < has_buckets:
            raise ConfigError(f"{where}: {self}: names no folder in it; add a name, such as {self}/set")

    @property
    def name(self) -> str:
        """The last part of the URL."""
        return self.url.partition("://")[2].rpartition("/")[2]

    def beside(self, name: str) -> WritableUrl:
        """Return another folder in the folder that this one is in."""
        return WritableUrl(self._where, f"{self.url.rpartition('/')[0]}/{name}")

    def below(self, name: str) -> WritableUrl:
        """Return a folder in this one."""
        return WritableUrl(self._where, f"{self.url}/{name}")

    # -- reading ---------------------------------------------------------------------------------------------------

    def sizes(self) -> dict[str, int]:
        """Return the bytes of every file below, by its name from here; none where there is nothing.

        Raises:
            CacheError: it cannot be listed.
        """

        def listed() -> dict[str, int]:
            files, root = self.opened()
            files.invalidate_cache()
            try:
                found: dict[str, Any] = files.find(root, detail=True)
            except FileNotFoundError:
                return {}
            start = f"{root.strip('/')}/"
            names = {name.lstrip("/"): told["size"] for name, told in found.items() if told["type"] == "file"}
            return {name[len(start) :]: int(size) for name, size in names.items() if name.startswith(start)}

        return self._tried("", "it cannot be listed", listed)

    def read_whole(self, name: str, *, max_bytes: int) -> bytes:
        """Return a file's content, as it is now.

        Raises:
            CacheError: missing (see :func:`is_missing`), larger than a file of its kind, or it cannot be read.
        """
        self.opened()[0].invalidate_cache()
        size = self.status(name).size
        if size > max_bytes:
            raise self._failed(name, f"has {size} bytes, more than the limit of {max_bytes} for this kind")
        return self.read(name, 0, size)

    def read_each(self, names: Iterable[str], *, max_bytes: int) -> dict[str, bytes]:
        """Return the contents of small files by name, of those that are there.

        Raises:
            CacheError: one is larger than a file of its kind, or cannot be read.
        """
        contents: dict[str, bytes] = {}

        def read(name: str) -> None:
            try:
                contents[name] = self.read_whole(name, max_bytes=max_bytes)
            except CacheError as error:
                if not is_missing(error):
                    raise

        self._each(read, names)
        return contents

    def fetch(self, names: Mapping[str, Path]) -> None:
        """Copy files to the disk, each to its path; folders that are missing are made.

        Raises:
            CacheError: one is missing (see :func:`is_missing`), cannot be read, or the disk cannot take it.
        """

        def fetch(name: str) -> None:
            def get() -> None:
                files, root = self.opened()
                files.get_file(f"{root}/{name}", str(names[name]))

            names[name].parent.mkdir(parents=True, exist_ok=True)
            self._tried(name, "it cannot be fetched", get)

        self._each(fetch, names)

    # -- writing ---------------------------------------------------------------------------------------------------

    def write(self, name: str, content: bytes) -> None:
        """Write a file: who reads it meanwhile reads the old content or the new.

        Raises:
            CacheError: it cannot be written.
        """

        def write() -> None:
            files, root = self.opened()
            _make_room(files, f"{root}/{name}")
            files.pipe_file(f"{root}/{name}", content)

        self._tried(name, "it cannot be written", write)

    def put(self, names: Mapping[str, Path]) -> None:
        """Copy files from the disk to their names here.

        Raises:
            CacheError: one cannot be written.
        """

        def put(name: str) -> None:
            def upload() -> None:
                files, root = self.opened()
                _make_room(files, f"{root}/{name}")
                files.put_file(str(names[name]), f"{root}/{name}")

            self._tried(name, "it cannot be written", upload)

        self._each(put, names)

    def copy(self, source: WritableUrl, names: Mapping[str, str]) -> None:
        """Copy files of another folder of the same store: ``names`` says for each name here what it is there.

        Nothing goes through this machine where the store can copy by itself.

        Raises:
            CacheError: one is missing (see :func:`is_missing`), or cannot be copied.
        """

        def copy(name: str) -> None:
            def copied() -> None:
                files, root = self.opened()
                _make_room(files, f"{root}/{name}")
                _copy(files, f"{source.opened()[1]}/{names[name]}", f"{root}/{name}")

            self._tried(name, "it cannot be written", copied)

        self._each(copy, names)

    def remove(self, names: Iterable[str]) -> None:
        """Delete files; what is gone already is fine.

        Raises:
            CacheError: one cannot be deleted.
        """

        def remove(name: str) -> None:
            def removed() -> None:
                files, root = self.opened()
                files.rm_file(f"{root}/{name}")

            try:
                self._tried(name, "it cannot be deleted", removed)
            except CacheError as error:
                if not is_missing(error):
                    raise

        self._each(remove, names)

    def _each(self, call: Callable[[str], None], names: Iterable[str]) -> None:
        """Do something with every name; with several at once where the file system can."""
        if not getattr(self.opened()[0], "async_impl", False):
            for name in names:
                call(name)
            return
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            waiting = [pool.submit(call, name) for name in names]
            try:
                for one in waiting:
                    one.result()
            finally:
                for one in waiting:
                    one.cancel()


def _make_room(files: Any, path: str) -> None:
    """Make the folders of a file, in file systems that have any; an object store would make a bucket of them."""
    if not getattr(files, "async_impl", False):
        files.makedirs(path.rpartition("/")[0], exist_ok=True)


def _copy(files: Any, source: str, target: str) -> None:
    try:
        files.cp_file(source, target)
    except NotImplementedError:  # through this machine
        with tempfile.TemporaryDirectory(prefix="pcdata-") as folder:
            files.get_file(source, f"{folder}/file")
            files.put_file(f"{folder}/file", target)
