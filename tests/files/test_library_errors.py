"""What libraries say of damaged files is told in words of ours, with the file and what to do."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pcdata.errors import CaptureError, NoReadingError
from pcdata.files.library_errors import WRITE_AGAIN, name_file, read_by_library, told_by_library

FOREIGN = ("Arrow", "thrift", "synchronously", "Errno", "Error:", "codec", "_io.", "OSError", "could not convert")


def parquet(damage: Callable[[bytes], bytes], path: Path) -> Any:
    pytest.importorskip("pyarrow")
    from pyarrow import parquet, table

    parquet.write_table(table({"a": np.arange(1000), "b": np.random.default_rng(0).random(1000)}), path)
    path.write_bytes(damage(path.read_bytes()))
    return parquet.read_table(io.BytesIO(path.read_bytes()))


def hdf5(damage: Callable[[bytes], bytes], path: Path) -> Any:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file["a/b"] = np.arange(1000)
    path.write_bytes(damage(path.read_bytes()))
    with h5py.File(path) as file:
        return file["a/b"][:]


def video(damage: Callable[[bytes], bytes], path: Path) -> Any:
    av = pytest.importorskip("av")
    path.write_bytes(damage(b"\x1a\x45\xdf\xa3" + bytes(4000)))
    with av.open(io.BytesIO(path.read_bytes())) as container:
        return list(container.decode(video=0))


def image(damage: Callable[[bytes], bytes], path: Path) -> Any:
    from PIL import Image

    Image.fromarray(np.zeros((40, 40), np.uint8)).save(path, format="PNG")
    path.write_bytes(damage(path.read_bytes())[4:])
    return np.asarray(Image.open(io.BytesIO(path.read_bytes())))


def text(damage: Callable[[bytes], bytes], path: Path) -> Any:
    path.write_bytes(damage(b"\xff" * 400).replace(b"\0", b"\xff"))
    return path.read_text("utf-8")


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "cut in half": lambda raw: raw[: len(raw) // 2],
    "cut at the end": lambda raw: raw[:-7],
    "another beginning": lambda raw: bytes(64) + raw[64:],
    "zeros": lambda raw: bytes(len(raw)),
    "noise": lambda raw: np.random.default_rng(1).bytes(len(raw)),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("library", [parquet, hdf5, video, image, text])
def test_damage_is_told_without_the_words_of_the_library(library: Any, damage: str, tmp_path: Path) -> None:
    path = tmp_path / "file"
    with pytest.raises(CaptureError) as caught, read_by_library("somebody", path, "file"):
        library(DAMAGES[damage], path)
    told = str(caught.value)
    assert told.startswith(f"somebody: {path}: not a readable file: ")
    assert told.endswith(WRITE_AGAIN)
    assert not [word for word in FOREIGN if word in told]
    assert caught.value.__cause__ is not None


def test_what_is_not_known_keeps_the_words_of_the_library() -> None:
    assert told_by_library(NotImplementedError("codec 'brotli' not built\nTraceback")) == (
        "NotImplementedError: codec 'brotli' not built"
    )
    assert told_by_library(KeyError()) == "KeyError"
    assert told_by_library(ValueError("'hello' is no number")) == "'hello' is no number"


def test_an_error_of_ours_names_the_file_once_and_keeps_its_type() -> None:
    path = Path("/captures/a.mkv")
    for said, told in (("a picture is damaged", "of a: /captures/a.mkv: a picture is damaged"),
                       ("/captures/a.mkv: is empty", "/captures/a.mkv: is empty")):  # fmt: skip
        with pytest.raises(NoReadingError) as caught, read_by_library("of a", path, "video"):
            raise NoReadingError(said)
        assert str(caught.value) == told
    error = CaptureError()
    name_file(error, path, "of a: /captures/a.mkv")
    assert "of a: /captures/a.mkv" in "".join([str(error), *getattr(error, "__notes__", [])])
