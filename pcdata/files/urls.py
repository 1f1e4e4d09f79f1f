"""The door for URLs: what lies behind ``s3://``, ``gs://``, ``https://``, ``memory://`` and the like is opened here.

fsspec does the work. A URL is what the user names; files that a dataset names lie below it. Each read asks for a range
of bytes by itself, so one that fails is asked for again, and nothing is half read. ``file://`` is a path, and goes
through the door for files.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from urllib.parse import unquote, urlsplit

from pcdata.errors import ConfigError, MissingExtraError, PcdataError, locate
from pcdata.extras import require

RETRIES = 3  # of a read that fails, before that is an error

_T = TypeVar("_T")
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+(?:://|::)")  # two letters or more: one is a drive
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")  # what a path makes of its beginning
_SECRET = re.compile(r"(?<=://)[^/@]*:[^/@]*(?=@)")
_FIRST_WAIT = 0.5  # seconds before the second attempt; twice as long before each later one
# What another attempt would not change.
_FINAL = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError, NotImplementedError, ImportError)
_MARKS = ("ETag", "etag", "md5", "content_md5", "LastModified", "last_modified", "mtime", "updated", "created")


def is_url(place: object) -> bool:
    """Whether a place is a URL that fsspec opens, and no path."""
    return isinstance(place, str) and _URL.match(place) is not None and not place.startswith("file://")


def is_in_process(place: object) -> bool:
    """Whether a place is in the memory of this process, where no other sees it."""
    return is_url(place) and str(place).startswith("memory:")


def path_of(place: str | os.PathLike[str]) -> Path:
    """Return the path that a place names which is no other URL, such as ``file:///data/set``."""
    if isinstance(place, str) and place.startswith("file://"):
        parts = urlsplit(place)
        return Path(unquote(parts.path if parts.netloc in ("", "localhost") else parts.netloc + parts.path))
    return Path(place)


def _is_full(cause: Exception) -> bool:
    return isinstance(cause, OSError) and cause.errno == errno.ENOSPC


def url_hint(path: str | os.PathLike[str]) -> str:
    """Return what to say of a path that was meant to be a URL, such as ``s3:/bucket``; "" of any other."""
    parts = Path(path).parts
    for place, part in enumerate(parts):
        if _SCHEME.fullmatch(part) and not Path(*parts[: place + 1]).exists():
            rest = "/".join(("",) * (part == "file:") + parts[place + 1 :])
            return (
                f"{part}//{rest} is a URL, and this works on the disk alone: give a path, and copy with a tool of the "
                "store, such as 'aws s3 sync'; 'pcdata verify' then says whether a dataset came whole"
            )
    return ""


class UrlStatus(NamedTuple):
    """What a server says of a file without sending it."""

    size: int
    identity: tuple[int, ...] | None  # the same so long as the file is; None where the server does not tell


class UrlFolder:
    """The files below a URL. It travels to other processes as the URL alone; each makes its own connection.

    Args:
        where: who asks, the first words of a message.
        url: of the folder.
        error: what is raised where a file is missing or cannot be read.
        options: what fsspec's file system of this URL takes, such as ``{"anon": True}``.
        retries: how often a read that fails is tried again.

    Raises:
        ConfigError: nobody knows this kind of URL.
        MissingExtraError: its package is not installed.
    """

    def __init__(
        self,
        where: str,
        url: str,
        *,
        error: type[PcdataError],
        options: Mapping[str, Any] | None = None,
        retries: int = RETRIES,
    ) -> None:
        self.url = url.rstrip("/")
        self._where = where
        self._error = error
        self._options = dict(options or {})
        self._retries = retries
        self._opened: tuple[int, Any, str] | None = None  # by which process, the file system, the root on it
        self.opened()

    def opened(self) -> tuple[Any, str]:
        """Return fsspec's file system of this process, and the folder's name on it."""
        # One that came through fork has threads and sockets of its parent.
        if self._opened is None or self._opened[0] != os.getpid():
            fsspec = require("fsspec")
            try:
                system, root = fsspec.core.url_to_fs(self.url, **self._options)
            except ImportError as cause:
                kind = self.url.partition(":")[0]
                way = 'pip install "pcdata[remote]"' if kind in ("s3", "s3a") else "install the package that it names"
                raise MissingExtraError(f"{self._where}: {self}: {kind}:// cannot be opened: {cause}; {way}") from cause
            except (ValueError, TypeError) as cause:
                raise ConfigError(f"{self._where}: {self}: fsspec cannot open such a URL: {cause}") from cause
            self._opened = os.getpid(), system, root.rstrip("/")
        return self._opened[1:]

    def status(self, name: str) -> UrlStatus:
        """Ask for the size of a file, and for what tells it from others of its name.

        Raises:
            PcdataError: of the type ``error``: missing, no file, or not to be had.
        """

        def ask() -> UrlStatus:
            system, root = self.opened()
            told = system.info(f"{root}/{name}")
            if told.get("type", "file") != "file" or type(told.get("size")) is not int:
                raise self._failed(name, f"must be a file of a stated size, but is {told.get('type')!r:.50}")
            marks = [f"{mark}={told[mark]}" for mark in _MARKS if told.get(mark)]
            digest = hashlib.sha256("\n".join(marks).encode()).digest()
            halves = int.from_bytes(digest[:8], "big") >> 1, int.from_bytes(digest[8:16], "big") >> 1
            return UrlStatus(told["size"], (*halves, told["size"], 0) if marks else None)

        return self._tried(name, "its size cannot be read", ask)

    def read(self, name: str, begin: int, end: int) -> bytes:
        """Read the bytes from ``begin`` to ``end`` of a file, all of them.

        Raises:
            PcdataError: of the type ``error``: missing, or it failed as often as it may; says which bytes.
        """

        def ask() -> bytes:
            system, root = self.opened()
            content: bytes = system.cat_file(f"{root}/{name}", start=begin, end=end)
            if len(content) != end - begin:
                raise OSError(f"{len(content)} bytes came")
            return content

        return self._tried(name, f"its bytes {begin} to {end} cannot be read", ask) if end > begin else b""

    def _tried(self, name: str, what: str, ask: Callable[[], _T]) -> _T:
        for attempt in range(self._retries + 1):
            if attempt:
                time.sleep(_FIRST_WAIT * 2 ** (attempt - 1))
            try:
                return ask()
            except PcdataError:
                raise
            except FileNotFoundError as cause:
                why = "the file is missing; check the URL, or copy it again"
                if "bucket does not exist" in str(cause):  # as S3 and Google say it
                    why = "there is no such bucket; check the URL, or make one with the tool of the store"
                raise self._failed(name, why) from cause
            except Exception as cause:  # every file system has errors of its own
                fault = cause
                if isinstance(cause, _FINAL) or "Credential" in type(cause).__name__ or _is_full(cause):
                    break
        tried = f"tried {attempt + 1} times; " if attempt else ""
        failed = self._failed(
            name,
            f"{what} ({type(fault).__name__}: {fault!s:.300}); {tried}check the connection and the rights, then go on",
        )
        raise failed from fault

    def _failed(self, name: str, what: str) -> PcdataError:
        place = f"{self}/{name}" if name else str(self)
        error = self._error(f"{self._where}: {place}: {what}")
        locate(error, path=place)
        return error

    def __str__(self) -> str:
        return _SECRET.sub("***", self.url)  # what a log may hold

    __repr__ = __str__

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None}
