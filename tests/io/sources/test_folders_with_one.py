"""A folder with one recording opens as the recording does, whatever kind it is; of several the names are told."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from pcdata import open_source
from pcdata.errors import CaptureError
from tests import lerobot_datasets, published_captures, simulated_captures


def robomimic(folder: Path) -> Path:
    pytest.importorskip("h5py")
    return simulated_captures.robomimic(folder)


def maniskill(folder: Path) -> Path:
    pytest.importorskip("h5py")
    return simulated_captures.maniskill(folder)


def lerobot(folder: Path) -> Path:
    for package in ("pyarrow", "av"):
        pytest.importorskip(package)
    return lerobot_datasets.lossless(folder / "set")


@pytest.mark.parametrize("make", [robomimic, maniskill, lerobot])
def test_the_folder_is_the_recording(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    inner = make(tmp_path)
    (tmp_path / "notes.txt").write_text("of our own")
    unit = {"metres_per_unit": 0.0001} if make is lerobot else {}
    by_folder, by_name = open_source(tmp_path, **unit), open_source(inner, **unit)
    assert (by_folder.kind, by_folder.ids) == (by_name.kind, by_name.ids)
    assert by_folder.episodes == by_name.episodes
    one, other = by_folder.load(by_folder.ids[-1]), by_name.load(by_name.ids[-1])
    assert torch.equal(one.depth, other.depth)


@pytest.mark.parametrize(("make", "ends"), [(robomimic, ".hdf5"), (maniskill, ".h5")])
def test_of_several_files_the_names_and_the_pattern_for_all_are_told(
    tmp_path: Path, make: Callable[[Path], Path], ends: str
) -> None:
    first = make(tmp_path)
    shutil.copy(first, tmp_path / f"second{ends}")
    if first.with_suffix(".json").exists():
        shutil.copy(first.with_suffix(".json"), tmp_path / "second.json")
    with pytest.raises(CaptureError, match=rf"holds .*second.*give the path of one, or '.*\*\{ends}' for all"):
        open_source(tmp_path)
    assert len(open_source(tmp_path / f"*{ends}")) == 2 * len(open_source(first))


def test_of_recordings_of_two_kinds_none_is_chosen(tmp_path: Path) -> None:
    for make in (robomimic, published_captures.azure_kinect):
        make(tmp_path)
    with pytest.raises(CaptureError, match=r"robomimic and azure_kinect.*--kind robomimic or --kind azure_kinect"):
        open_source(tmp_path)
    assert open_source(tmp_path, kind="azure_kinect").kind == "azure_kinect"


def test_of_several_recordings_the_pattern_for_all_is_told(tmp_path: Path) -> None:
    first = published_captures.azure_kinect(tmp_path)
    shutil.copy(first, tmp_path / "second.mkv")
    with pytest.raises(CaptureError, match=r"give the path of one, or '.*/\*\.mkv' for all"):
        open_source(tmp_path)
    assert len(open_source(tmp_path / "*.mkv")) == 4


def test_a_recording_beside_a_capture_is_not_the_capture(tmp_path: Path) -> None:
    robomimic(tmp_path)
    published_captures.pairs(tmp_path)
    assert open_source(tmp_path).kind == "pairs"


def test_a_link_out_of_the_folder_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "demo.hdf5").symlink_to(robomimic(tmp_path / "elsewhere"))
    with pytest.raises(CaptureError, match="here"):
        open_source(tmp_path / "here")
