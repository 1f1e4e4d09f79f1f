"""Recordings in one file: what is the same for every kind of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from pcdata import open_source
from pcdata.errors import CaptureError
from tests import published_captures as made
from tests.recordings import recording, written

KINDS = {"azure_kinect": ".mkv", "realsense_bag": ".bag"}


def made_of(kind: str, folder: Path) -> Path:
    if kind == "azure_kinect":
        return made.azure_kinect(folder)
    pytest.importorskip("rosbags")
    return written(folder / "recording.bag", recording())


@pytest.mark.parametrize("kind", KINDS)
def test_a_folder_with_two_recordings_is_refused_with_the_names_of_both(tmp_path: Path, kind: str) -> None:
    one = made_of(kind, tmp_path)
    one.with_stem("again").write_bytes(one.read_bytes())
    with pytest.raises(CaptureError, match=rf"holds 2 recordings, .*again\{KINDS[kind]}.*; give the path of one"):
        open_source(tmp_path, kind=kind)


@pytest.mark.parametrize("kind", KINDS)
def test_a_folder_with_no_recording_is_refused_with_what_the_layout_needs(tmp_path: Path, kind: str) -> None:
    (tmp_path / f"other{KINDS[kind]}").write_bytes(b"no recording")
    with pytest.raises(CaptureError, match=rf"holds no recording; this layout needs an? .*\{KINDS[kind]} "):
        open_source(tmp_path, kind=kind)


@pytest.mark.parametrize("kind", KINDS)
def test_times_of_samples_and_of_their_episode_are_the_same_seconds(tmp_path: Path, kind: str) -> None:
    source = open_source(made_of(kind, tmp_path))
    times = [source.load(name).provenance["timestamps"][0] for name in source.ids]
    assert times == list(source.episodes[0].times)
    assert 0.01 < times[1] - times[0] < 0.1


def test_a_recording_that_is_cut_short_says_how_much_is_missing_and_what_is_whole(tmp_path: Path) -> None:
    path = made_of("azure_kinect", tmp_path)
    raw, whole = path.read_bytes(), open_source(path)
    assert not any("cut short" in line for line in whole.unread())
    for share in (0.8, 0.9, 1 - 7 / len(raw)):
        path.write_bytes(raw[: round(share * len(raw))])
        missing = len(raw) - path.stat().st_size
        source = open_source(path)
        (told,) = (line for line in source.unread() if "cut short" in line)
        assert told.startswith(f"{path.name}: it is cut short: {missing} bytes are missing at its end; {len(source)} ")
    path.write_bytes(raw[: len(raw) // 3])
    with pytest.raises(CaptureError, match=r"its track DEPTH has no image; it is cut short: \d+ bytes .*copy it again"):
        open_source(path)


@pytest.mark.parametrize("kind", KINDS)
def test_an_empty_recording_is_called_empty(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"recording{KINDS[kind]}"
    path.write_bytes(b"")
    with pytest.raises(CaptureError, match="the file is empty"):
        open_source(path, kind=kind)
