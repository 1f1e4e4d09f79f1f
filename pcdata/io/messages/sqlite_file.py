"""ROS 2 bags in SQLite (.db3): a table of topics and one of messages, read by their numbers.

Source: rosbag2_storage_sqlite3, schema versions 1 to 4.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

import numpy as np

from pcdata.errors import CaptureError
from pcdata.files.opening import MAX_STREAMED_BYTES, existing_file
from pcdata.io.messages.log_file import LATEST, MAX_MESSAGE, Index, LogFile, Place, Read, said_of, type_name

_MAGIC = b"SQLite format 3\0"
_TABLES = {
    "topics": ("id", "name", "type", "serialization_format"),
    "messages": ("id", "topic_id", "timestamp", "data"),
}
_MAX_TEXT = 1000
_INDEX = "SELECT id, topic_id, timestamp FROM messages ORDER BY id"


Rows = dict[int, list[tuple[int, int, int]]]


class SqliteFile(LogFile):
    """One .db3 file; a place is (the message's id, 0)."""

    suffix = ".db3"
    container = "ROS 2 bag"

    @classmethod
    def _begins_so(cls, stream: BinaryIO) -> bool:
        return stream.read(len(_MAGIC)) == _MAGIC

    def index(self) -> Index:
        """Return what the tables hold, as far as they can be read."""
        found = Index()
        rows: Rows = {}
        with self._connected() as connection:
            names: dict[int, str] = {}
            for number, *texts in connection.execute("SELECT id, name, type, serialization_format FROM topics"):
                are_texts = all(isinstance(one, str) and len(one) < _MAX_TEXT for one in texts)
                if not (isinstance(number, int) and are_texts):
                    raise CaptureError(f"{self.path}: the table of topics is damaged")
                names[number], kind, encoding = texts
                found.add_topic(names[number], type_name(kind), encoding)
            found.damage = self._cut_short()
            try:
                for number, topic, time in connection.execute(_INDEX):
                    is_time = isinstance(time, int) and 0 <= time <= LATEST
                    fits = isinstance(number, int) and is_time and topic in names
                    if found.damage is not None and not (fits and _goes_on(connection, rows, number)):
                        break
                    if not fits:
                        raise CaptureError(f"{self.path}: message {number!r:.40} of topic {topic!r:.40} is damaged")
                    rows.setdefault(topic, []).append((time, number, 0))
            except sqlite3.DatabaseError as error:
                if not rows:
                    raise
                found.damage = found.damage or f"a part cannot be read: {error}"
            if found.damage is not None:
                _drop_last(rows)
                found.damage += f"; {sum(map(len, rows.values()))} messages can be read"
        for topic, messages in rows.items():
            table = np.array(messages, np.int64)
            found.add(names[topic], table[:, 0], table[:, 1:])
        log = self.path.with_name(f"{self.path.name}-wal")
        if log.exists() and log.stat().st_size:
            told = f"what lies in {log.name} is not read; open the bag once with sqlite3 to take it in"
            found.damage = told if found.damage is None else f"{found.damage}; {told}"
        return found

    @contextmanager
    def opened(self) -> Iterator[Read]:
        """Open the file."""
        with self._connected() as connection:

            def read(place: Place, most: int | None = None) -> bytes:
                if most is not None and hasattr(connection, "blobopen"):
                    with connection.blobopen("messages", "data", place[0], readonly=True) as blob:
                        return bytes(blob.read(most))
                row: Any = connection.execute("SELECT length(data) FROM messages WHERE id = ?", (place[0],)).fetchone()
                if row is None or not isinstance(row[0], int) or row[0] > MAX_MESSAGE:
                    raise CaptureError(f"{self.path}: message {place[0]} is lost or damaged")
                (data,) = connection.execute("SELECT data FROM messages WHERE id = ?", (place[0],)).fetchone()
                if not isinstance(data, bytes):
                    raise CaptureError(f"{self.path}: message {place[0]} is damaged")
                return data if most is None else data[:most]

            yield read

    @contextmanager
    def _connected(self) -> Iterator[sqlite3.Connection]:
        with said_of(self.path):
            file = existing_file(self.container, self.path, max_bytes=MAX_STREAMED_BYTES)
            # Immutable: nothing is written beside the file, and no lock is taken.
            where = f"file:{quote(str(Path(file).absolute()))}?mode=ro&immutable=1"
            try:
                with closing(sqlite3.connect(where, uri=True)) as connection:
                    connection.execute("PRAGMA trusted_schema = OFF")
                    # Else a file that was cut short is refused as a whole; nothing can be written to what is read-only.
                    connection.execute("PRAGMA writable_schema = ON")
                    self._check_tables(connection)
                    yield connection
            except sqlite3.Error as error:
                raise CaptureError(f"{self.path}: not a readable ROS 2 bag: {str(error)[:300]}") from error

    def _cut_short(self) -> str | None:
        """Say how much of the file is missing, by its own header."""
        with self._stream() as (stream, size):
            head = stream.read(32)
        page, pages = int.from_bytes(head[16:18], "big"), int.from_bytes(head[28:32], "big")
        whole = (65536 if page == 1 else page) * pages
        return f"it is cut short, {size} of {whole} bytes" if whole > size else None

    def _check_tables(self, connection: sqlite3.Connection) -> None:
        """Require plain tables with the columns that are read: a view or a generated column would run what it says."""
        for table, columns in _TABLES.items():
            kind = connection.execute("SELECT type FROM sqlite_master WHERE name = ?", (table,)).fetchall()
            told = {row[1]: row[6] for row in connection.execute(f"PRAGMA table_xinfo({table})")}
            if kind != [("table",)] or any(told.get(column) != 0 for column in columns):
                raise CaptureError(
                    f"{self.path}: is no ROS 2 bag: it needs the tables topics ({', '.join(_TABLES['topics'])}) and "
                    f"messages ({', '.join(_TABLES['messages'])})"
                )


def _goes_on(connection: sqlite3.Connection, rows: Rows, number: int) -> bool:
    """Say whether a message of a damaged file follows the one before it, and is there.

    SQLite reads what is missing of a page as zeros; messages are written one after another.
    """
    before = max((messages[-1][1] for messages in rows.values()), default=number - 1)
    try:
        query = connection.execute("SELECT data FROM messages WHERE id = ?", (number,))
        return number == before + 1 and query.fetchone() is not None
    except sqlite3.DatabaseError:
        return False


def _drop_last(rows: Rows) -> None:
    """Take away the last message: the end of its last page may be missing."""
    if rows:
        topic = max(rows, key=lambda one: rows[one][-1][1])
        rows[topic].pop()
        if not rows[topic]:
            del rows[topic]
