"""A recording of messages by topic: one file, or the several that one recording was split into."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from pcdata.errors import CaptureError
from pcdata.files.library_errors import WRITE_AGAIN
from pcdata.files.opening import MAX_STREAMED_BYTES, check_inside, existing_file, read_text
from pcdata.io.messages.bag_file import BagFile
from pcdata.io.messages.log_file import MAX_MESSAGE, LogFile, Topic
from pcdata.io.messages.mcap_file import McapFile
from pcdata.io.messages.packing import unpacked_zstd
from pcdata.io.messages.sqlite_file import SqliteFile
from pcdata.yaml_nodes import parse_yaml

CONTAINERS: tuple[type[LogFile], ...] = (BagFile, McapFile, SqliteFile)
METADATA = "metadata.yaml"  # beside the files of a ROS 2 bag
_MAX_METADATA = 1 << 24
_TOGETHER = 1 << 14  # messages whose numbers are Python's at one time


def container_of(path: Path) -> type[LogFile] | None:
    """Return the container that a file is, by its suffix and its first bytes; never raises."""
    return next((one for one in CONTAINERS if path.suffix.lower() == one.suffix and one.begins_so(path)), None)


class MessageLog:
    """The topics of a recording. It holds paths and numbers only, no open file."""

    def __init__(self, files: list[LogFile], *, packed: bool = False) -> None:
        """Read the index of every file.

        Args:
            files: of one recording, in order.
            packed: every message is packed with zstd by itself.

        Raises:
            CaptureError: a file is damaged so that nothing of it can be read, or a topic changes its type.
        """
        self.files, self._packed = files, packed
        self.damage: list[str] = []
        self.topics: dict[str, Topic] = {}
        indexes = [file.index() for file in files]
        for file, index in zip(files, indexes):
            if index.damage is not None:
                self.damage.append(f"{file.path.name}: {index.damage}")
        for name in sorted({name for index in indexes for name in index.topics}):
            told = {index.topics[name] for index in indexes if name in index.topics}
            if len(told) > 1:
                raise CaptureError(f"{files[0].path.parent}: topic {name!r:.200} holds messages of {sorted(told)}")
            times, places = [np.empty(0, np.int64)], [np.empty((0, 3), np.int64)]
            for number, index in enumerate(indexes):
                for some, where in zip(index.times.get(name, ()), index.places.get(name, ())):
                    times.append(some)
                    places.append(np.column_stack([np.full(len(some), number, np.int64), where]))
            joined = np.concatenate(times)
            order = np.argsort(joined, kind="stable")
            kind, encoding = told.pop()
            self.topics[name] = Topic(name, kind, encoding, joined[order], np.concatenate(places)[order])

    @contextmanager
    def opened(self) -> Iterator[Callable[..., bytes]]:
        """Open the files as they are needed; gives what reads message ``number`` of a topic, or the start of it.

        Raises:
            CaptureError: a file or a message is damaged.
        """
        with ExitStack() as stack:
            readers: dict[int, Any] = {}

            def read(topic: Topic, number: int, most: int | None = None) -> bytes:
                if not 0 <= number < len(topic):
                    raise CaptureError(f"topic {topic.name} has {len(topic)} messages, there is no number {number}")
                file, *place = topic.places[number].tolist()
                if file not in readers:
                    readers[file] = stack.enter_context(self.files[file].opened())
                if not self._packed:
                    return readers[file](tuple(place), most)
                content = unpacked_zstd(readers[file](tuple(place), None), MAX_MESSAGE + 1 if most is None else most)
                if len(content) > MAX_MESSAGE:
                    raise CaptureError(f"a message of {topic.name} unpacks to more than {MAX_MESSAGE} bytes")
                return content

            yield read

    def only(self, topics: list[str]) -> MessageLog:
        """Return the recording with these topics alone, such as those that workers need."""
        smaller: MessageLog = object.__new__(MessageLog)
        smaller.files, smaller._packed, smaller.damage = self.files, self._packed, self.damage
        smaller.topics = {name: self.topics[name] for name in topics if name in self.topics}
        return smaller


def in_file_order(topics: Sequence[Topic]) -> Iterator[tuple[Topic, int]]:
    """Yield every message of some topics as they lie in the files, so that a packed chunk is unpacked once for all."""
    if not topics:
        return
    places = np.concatenate([topic.places for topic in topics])
    owners = np.repeat(np.arange(len(topics)), [len(topic) for topic in topics])
    numbers = np.concatenate([np.arange(len(topic)) for topic in topics])
    order = np.lexsort((places[:, 2], places[:, 1], places[:, 0]))
    for start in range(0, len(order), _TOGETHER):
        some = order[start : start + _TOGETHER]
        for owner, number in zip(owners[some].tolist(), numbers[some].tolist()):
            yield topics[owner], number


def opened_log(where: str, path: Path, links_to: tuple[Path, ...] = ()) -> MessageLog:
    """Open one file, or the folder of a ROS 2 bag.

    Raises:
        CaptureError: it is no recording, a file of it is missing, or it is packed as a whole.
    """
    if not path.is_dir():
        container = container_of(path)
        if container is None:
            existing_file(where, path, max_bytes=MAX_STREAMED_BYTES)  # one that is empty says so
            raise CaptureError(f"{where}: does not begin as a ROS 1 bag, an MCAP file or a ROS 2 bag; {WRITE_AGAIN}")
        return MessageLog([container(path)])
    told = _metadata(where, path, links_to)
    names = told.get("relative_file_paths")
    if not isinstance(names, list) or not names or not all(isinstance(name, str) and name for name in names):
        raise CaptureError(f"{where}: {METADATA} names no files (relative_file_paths)")
    files: list[LogFile] = []
    for name in names:
        file = path / PurePosixPath(name).name  # older recorders wrote the folder too
        check_inside(where, file, [path, *links_to])
        container = container_of(file)
        if container is None:
            raise CaptureError(
                f"{where}: {METADATA} names {file.name}, which is missing or no .mcap or .db3 file"
                + (f"; unpack it: zstd -d {file.name}" if file.suffix == ".zstd" else "")
            )
        files.append(container(file))
    mode = str(told.get("compression_mode") or "").lower()
    if mode == "message" and told.get("compression_format") != "zstd":
        raise CaptureError(f"{where}: messages are packed with {told.get('compression_format')!r:.50}; known is zstd")
    log = MessageLog(files, packed=mode == "message")
    count, found = told.get("message_count"), sum(map(len, log.topics.values()))
    if isinstance(count, int) and count != found:
        log.damage.append(f"{METADATA} says {count} messages, the files have {found}")
    return log


def _metadata(where: str, path: Path, links_to: tuple[Path, ...]) -> Mapping[str, Any]:
    text = read_text(where, path / METADATA, max_bytes=_MAX_METADATA, inside=[path, *links_to])
    try:
        document = parse_yaml(text)
    except ValueError as error:
        raise CaptureError(f"{where}: {METADATA} cannot be read: {str(error)[:300]}") from error
    told = document.get("rosbag2_bagfile_information") if isinstance(document, dict) else None
    if not isinstance(told, dict):
        raise CaptureError(f"{where}: {METADATA} is not that of a ROS 2 bag (rosbag2_bagfile_information)")
    return told
