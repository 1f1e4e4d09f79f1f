"""Of a path that has no known layout the error gives the command that reads it, and that command works."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pcdata import open_source
from pcdata.cli.main import main
from pcdata.errors import CaptureError
from tests.captures import folder_capture
from tests.published_captures import color, image, pairs

LENS = "60 60 31.5 23.5"
DEPTH = (700 + 3 * np.arange(48)[:, None] + 2 * np.arange(64)).astype(np.uint16)  # millimetres of a slanted plane


def images(folder: Path) -> Path:
    """A folder of 16-bit images whose names do not tell that they are depth, one with a picture beside it."""
    for number in range(3):
        image(folder / f"{number:04d}.png", DEPTH + number)
        image(folder / f"{number:04d}_rgb.png", color(number, (48, 64)))
    return folder


def one_image(folder: Path) -> Path:
    return images(folder) / "0001.png"


def a_picture_of_a_capture(folder: Path) -> Path:
    return pairs(folder) / "color_000.png"


def a_calibration_of_a_capture(folder: Path) -> Path:
    return pairs(folder) / "phoxi.intr"


def one_capture_inside(folder: Path) -> Path:
    pairs(folder / "an archive" / "scene 1")
    (folder / "LICENSE").write_text("free")
    return folder


def captures_inside(folder: Path) -> Path:
    for name in ("left", "right"):
        pairs(folder / name)
    return folder


def bag_inside(folder: Path) -> Path:
    recordings = pytest.importorskip("tests.ros_recordings")
    make = recordings.Types(2)
    (folder / "bag").mkdir(parents=True)
    recordings.written(folder / "bag" / "take.mcap", recordings.recording(make), make)
    return folder


@pytest.mark.parametrize(
    ("make", "count"),
    [
        (images, 3),
        (one_image, 1),
        (a_picture_of_a_capture, 3),
        (a_calibration_of_a_capture, 3),
        (one_capture_inside, 3),
        (captures_inside, 6),
        (bag_inside, None),
    ],
)
def test_the_command_that_is_told_reads_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], make: Callable[[Path], Path], count: int | None
) -> None:
    path = make(tmp_path / "of mine")
    assert main(["inspect", str(path)]) == 1
    (told,) = capsys.readouterr().err.splitlines()
    command = re.findall(r"pcdata (inspect .+?)(?:\. docs|, or|$)", told)[-1].replace("FX FY CX CY", LENS)
    assert main(shlex.split(command)) == 0
    out = capsys.readouterr().out
    assert count is None or f"captures  {count}: " in out
    assert "view0: 64x48, fx 60.0" in out or count is None or make not in (images, one_image)


def test_images_without_any_word_are_depth_where_the_layout_is_asked_for(tmp_path: Path) -> None:
    source = open_source(images(tmp_path), kind="pairs", intrinsics=(60, 60, 31.5, 23.5), metres_per_unit=0.001)
    assert source.ids == ["0000", "0001", "0002"]
    frame = source.load("0002")
    assert np.abs(frame.depth[0].numpy() - (DEPTH + 2) / 1000).max() < 1e-6
    assert frame.colors is not None


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda root: image(root / "0.png", color(0)).parent, "must be 16-bit gray, but this is a color image"),
        (lambda root: image(root / "0.jpg", color(0)).parent, "These are pictures; depth is stored in 16-bit PNG"),
        (lambda root: image(root / "depth" / "0.png", DEPTH).parents[1], r"neither is there.*\"fx\": 600"),
        (lambda root: root.mkdir() or root, "The layouts and what each needs:\n  folder: "),
    ],
)
def test_what_holds_no_depth_or_no_camera_is_told(tmp_path: Path, make: Callable[[Path], Path], words: str) -> None:
    with pytest.raises(CaptureError, match=rf"(?s)no known layout.*{words}"):
        open_source(make(tmp_path / "of mine"))


def test_a_folder_that_holds_thousands_is_not_searched_through(tmp_path: Path) -> None:
    for number in range(300):
        (tmp_path / f"{number:03d}").mkdir()
    folder_capture(tmp_path / "999" / "inside")
    with pytest.raises(CaptureError, match="The layouts"):
        open_source(tmp_path)


@pytest.mark.parametrize("command", ["validate", "convert", "build"])
def test_every_command_is_given_again_with_what_is_needed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    (tmp_path / "in").mkdir()
    np.save(tmp_path / "in" / "depth_0.npy", DEPTH)
    (tmp_path / "c.yaml").write_text("depth: [Deproject]\n")
    words = {
        "validate": [str(tmp_path / "in")],
        "convert": [str(tmp_path / "in"), "--to", "folder", "--out", str(tmp_path / "out")],
        "build": [str(tmp_path / "c.yaml"), "--source", str(tmp_path / "in"), "--out", str(tmp_path / "out")],
    }[command]
    assert main([command, *words]) == 1
    for _ in range(2):
        told = "".join(capsys.readouterr())
        (line,) = re.findall(r"next: pcdata (.+)", told)
        assert "--metres-per-unit 0.001" in line
        followed = shlex.split(line.replace("FX FY CX CY", LENS))
        if main(followed) == 0:
            return
    raise AssertionError("the command that is told does not work")


def test_an_hdf5_file_that_is_cut_short_is_told_so(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "demo.hdf5"
    with h5py.File(path, "w") as file:
        file["data/demo_0/obs/front_depth"] = np.ones((3, 8, 8, 1), np.float32)
    path.write_bytes(path.read_bytes()[:-500])
    for given in (path, tmp_path):
        with pytest.raises(CaptureError, match=r"demo\.hdf5: not a readable HDF5 file: .*shorter.*[Cc]opy"):
            open_source(given)
