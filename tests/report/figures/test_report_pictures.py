"""`pcdata report --png`: a folder of pictures or one, from what the page tells too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pcdata.cli import main
from pcdata.report.figures.panels import picture_panel
from pcdata.report.html.pictures import NO_READING, depth_picture
from tests.validation.captures import scene, store

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return store(tmp_path_factory.mktemp("png") / "capture", list(scene(num_views=1).noisy_frames(3)))


def names(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.iterdir())


def colored(file: Path) -> float:
    with Image.open(file) as opened:
        image = np.asarray(opened.convert("RGB")).astype(int)
    return float((abs(image - 255).max(axis=2) > 24).mean())


def test_a_folder_holds_the_panels_of_this_run_and_no_page_is_written(captures, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "shown"
    folder.mkdir()
    for name in ("sample_01.png", "sample_07.png", "own.png"):  # of a longer run, and of somebody else
        (folder / name).write_bytes(b"before")
    assert main(["report", str(captures), "--png", "shown", "--samples", "2"]) == 0
    assert "pictures shown (5)" in capsys.readouterr().out
    assert names(tmp_path) == ["shown"]
    assert names(folder) == ["numbers.png", "own.png", "planes.png", "sample_01.png", "sample_02.png", "summary.png"]
    assert (folder / "own.png").read_bytes() == b"before"
    (folder / "own.png").unlink()
    assert all(colored(file) > 0.01 for file in folder.iterdir())
    assert colored(folder / "sample_01.png") > 0.2


def test_one_picture_of_all_beside_the_page(captures, tmp_path):
    whole, page = tmp_path / "all.png", tmp_path / "page.html"
    assert main(["report", str(captures), "--png", str(whole), "--out", str(page), "--samples", "1"]) == 0
    with Image.open(whole) as image:
        width, height = image.size
    assert height > width
    assert page.stat().st_size > 100_000


def test_a_file_is_no_folder_and_captures_are_left_alone(captures, tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    assert main(["report", str(captures), "--png", str(tmp_path / "notes.txt")]) == 1
    heard = capsys.readouterr()
    assert "is a file; give a folder for several pictures, or a name that ends in .png" in heard.err
    assert "report 1/" not in heard.err  # told before captures are judged
    before = names(captures)
    assert main(["report", str(captures), "--png", str(captures / "shown")]) == 2
    assert "inside the captures" in capsys.readouterr().err
    assert names(captures) == before


def test_pixels_without_a_reading_are_magenta_as_on_the_page():
    from matplotlib.figure import Figure

    frame = next(iter(scene(num_views=1).noisy_frames(1)))
    frame.depth[:, :20] = 0
    axis = Figure().add_subplot()
    picture_panel(axis, caption="depth", png=depth_picture(frame, 0))
    drawn = np.asarray(axis.get_images()[0].get_array())
    assert drawn.shape[2] == 3
    assert (drawn[0, 0] == NO_READING).all()
    assert not (drawn[-1] == NO_READING).all(axis=1).all()
