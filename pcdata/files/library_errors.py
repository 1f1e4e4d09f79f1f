"""Libraries that read files fail in ways and words of their own; here that becomes one error that names the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pcdata.errors import CaptureError, PcdataError, add_note, locate
from pcdata.files.opening import told_at

WRITE_AGAIN = "damaged, cut short or of another format? Copy or write it again"

# What libraries say of damaged files, in small letters, and what it means to a reader; the first that fits counts.
_MEANINGS = (
    ("magic bytes not found", "it does not begin and end as a Parquet file does"),  # pyarrow
    ("deserialize thrift", "what says where its columns lie is damaged"),
    ("page header", "what says where its columns lie is damaged"),
    ("file signature not found", "it does not begin as an HDF5 file does"),  # h5py
    ("truncated file", "it is shorter than it says"),
    ("able to synchronously", "what it holds at one place is damaged"),
    ("invalid data found when processing input", "what stands there is no picture"),  # FFmpeg
    ("cannot identify image file", "it does not begin as an image does"),  # Pillow
    ("codec can't decode", "it is no UTF-8 text"),
)


def told_by_library(error: Exception) -> str:
    """Return what is wrong with a file by what a library raised, in words of ours where they are known, else in its."""
    said = str(error)
    for words, meaning in _MEANINGS:
        if words in said.lower():
            return meaning
    first = said.partition("\n")[0][:300]
    return first if first and type(error) is ValueError else f"{type(error).__name__}: {first}".removesuffix(": ")


def name_file(error: PcdataError, path: str | Path, told: str) -> None:
    """Let the message of an error in flight begin with ``told``, which names the file, unless it names it itself."""
    if str(path) in str(error):
        return
    if error.args and isinstance(error.args[0], str):
        locate(error, path=path)
        error.args = (f"{told}: {error.args[0]}", *error.args[1:])
    else:
        add_note(error, f"while reading {told}")


@contextmanager
def read_by_library(where: str, path: Path, what: str) -> Iterator[None]:
    """Name the file in whatever goes wrong within.

    Args:
        where: for messages.
        path: the file.
        what: it must be, in words.

    Raises:
        CaptureError: the library cannot read it.
        PcdataError: raised within; its message then names the file.
    """
    try:
        yield
    except PcdataError as error:
        name_file(error, path, told_at(where, path))
        raise
    except Exception as error:  # Arrow's and FFmpeg's errors are of many types, some of them of Python's own
        raise CaptureError(
            f"{told_at(where, path)}: not a readable {what}: {told_by_library(error)}; {WRITE_AGAIN}"
        ) from error
