"""Whoever makes clouds is told of a unit or poses that cannot be right; right ones get no word."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from pcdata import open_source
from pcdata.build import build_dataset, config_from_yaml
from pcdata.cli import main
from pcdata.geometry import rigid
from pcdata.io import write_capture
from pcdata.structures import DepthFrame
from pcdata.synthetic import tabletop
from pcdata.validation import first_look
from pcdata.validation.first_look import FirstLook, first_fault, judge_of_all
from pcdata.verdicts import Verdict


def frame_of(*, wrong: tuple[int, ...] = ()) -> DepthFrame:
    frame = tabletop(3, num_objects=4, num_views=2, size=(120, 160)).frame
    poses = frame.world_from_camera.clone()
    for view in wrong:
        poses[view] = rigid.invert_rigid(poses[view])
    return replace(frame, world_from_camera=poses)


def test_right_poses_unposed_captures_and_clouds_get_no_word() -> None:
    right = frame_of()
    assert first_fault([right]) is None
    assert first_fault([replace(right, world_from_camera=None, frame_id=None)]) is None
    assert first_fault([]) is None


@pytest.mark.parametrize("wrong", [(0, 1), (1,)])
def test_inverted_poses_are_told(wrong: tuple[int, ...]) -> None:
    found = first_fault([frame_of(wrong=wrong)])
    assert found is not None
    assert found.verdict is Verdict.FAIL
    assert "camera_from_world" in found.advice


@pytest.fixture
def moving(tmp_path: Path) -> Path:
    """One camera at two places, its poses written the wrong way."""
    frame = frame_of(wrong=(0, 1))
    write_capture(frame, tmp_path / "rig")
    one = tmp_path / "rig" / "view0"
    name = next((one / "depth").iterdir()).stem
    for folder in ("depth", "color", "labels", "poses"):
        for view, other in ((0, "a"), (1, "b")):
            source = tmp_path / "rig" / f"view{view}" / folder
            for file in list(source.glob(f"{name}.*")) if source.is_dir() else []:
                (one / folder / f"{other}{file.suffix}").write_bytes(file.read_bytes())
    for folder in ("depth", "color", "labels", "poses"):
        for file in (one / folder).glob(f"{name}.*"):
            file.unlink()
    return one


def test_the_commands_that_use_poses_say_so(moving: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = open_source(moving)
    assert source.ids == ["a", "b"]
    look = FirstLook()
    assert [look.see(source.load(name)) for name in source.ids] == [None, None]
    assert "camera_from_world" in (look.end() or "")
    assert look.end() is None, "told once"
    words = ["build", "--model", "dp3_sim", "--set", "crop=none", "--source", str(moving)]
    assert main([*words, "--set", "frame=base", "--out", str(tmp_path / "set")]) == 0
    printed = capsys.readouterr()
    assert "note     the poses look wrong: " in printed.out
    assert f"(pcdata validate {moving} judges all captures)" in printed.out
    assert "build: the poses look wrong: " in printed.err
    assert main([*words, "--set", "frame=camera", "--out", str(tmp_path / "own")]) == 0
    assert "look wrong" not in capsys.readouterr().out, "clouds that stay in the camera's frame need no pose"
    assert main(["fuse", str(moving), "--voxel-size", "0.01", "--out", str(tmp_path / "s.ply")]) == 0
    assert "fuse: the poses look wrong" in capsys.readouterr().err
    # What the advice says to read it by is right.
    right = ["--option", "convention.poses=camera_from_world"]
    assert main([*words, "--set", "frame=base", "--out", str(tmp_path / "right"), *right]) == 0
    assert "look wrong" not in capsys.readouterr().out


def test_overlap_fails_a_view_whose_pose_is_inverted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_capture(frame_of(wrong=(1,)), tmp_path / "rig")
    assert main(["calib", "overlap", str(tmp_path / "rig")]) == 1
    assert "camera_from_world" in capsys.readouterr().out
    far = frame_of()
    poses = far.world_from_camera.clone()
    poses[1, :3, 3] += torch.from_numpy(np.array([50.0, 0.0, 0.0]))
    write_capture(replace(far, world_from_camera=poses), tmp_path / "far")
    main(["calib", "overlap", str(tmp_path / "far")])
    out = capsys.readouterr().out
    assert "shares no surface with another camera; if it should, check its pose" in out
    assert "overlap 0 %, too little to measure" in out
    assert "nan" not in out


def test_a_unit_that_does_not_fit_comes_before_poses_and_needs_none(
    moving: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    right = frame_of()
    wrong = replace(right, depth=0.1 * right.depth, provenance={"metres_per_unit": 0.0001})
    found = first_fault([wrong])
    assert found is not None
    assert found.name == "depth_unit"
    assert first_fault([replace(wrong, world_from_camera=None, frame_id=None)], by_pose=False) == found
    stated = moving / "intrinsics.json"
    unit = json.loads(stated.read_text())
    stated.write_text(json.dumps(unit | {"metres_per_unit": 0.1 * unit["metres_per_unit"]}))
    words = ["build", "--model", "dp3_sim", "--set", "crop=none", "--set", "frame=camera", "--source", str(moving)]
    assert main([*words, "--out", str(tmp_path / "set")]) == 0
    assert "note     the unit of depth looks wrong: half of the readings lie within" in capsys.readouterr().out


class Counted:
    """Views of a camera at two places in turn, its poses written the wrong way; counts what is loaded."""

    kind = "counted"
    loaded: ClassVar[list[str]] = []  # not of one source: what it is must stay the same from build to build

    def __init__(self, count: int, wrong: bool = True) -> None:
        frame = frame_of(wrong=(0, 1) if wrong else ())
        self._views = [frame.view(0), frame.view(1)]
        self.ids = [f"{number:03d}" for number in range(count)]
        self.loaded.clear()

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id: str) -> DepthFrame:
        self.loaded.append(sample_id)
        return replace(self._views[int(sample_id) % 2], sample_id=sample_id)


def build_of(source: Any, folder: Path, **options: Any) -> Any:
    text = "depth: [Deproject]\ncloud: [ToFrame: {frame: base}]\noutput: {format: npz, shard_size: 3}"
    return build_dataset(config_from_yaml(text), source, folder, **options)


def test_a_build_looks_at_what_it_reads_tells_it_when_the_first_shard_is_done_and_reads_nothing_twice(
    tmp_path: Path,
) -> None:
    source = Counted(7)
    told: list[tuple[str, int]] = []
    report = build_of(source, tmp_path / "set", note=lambda text: told.append((text, len(source.loaded))))
    assert source.loaded == source.ids
    assert report.look.startswith("the poses look wrong: ")
    assert told == [(f"{report.look} {judge_of_all(source)}", 3)]
    assert build_of(Counted(7, wrong=False), tmp_path / "right").look == ""


def test_a_build_that_goes_on_says_it_before_it_works(tmp_path: Path) -> None:
    source = Counted(7)
    build_of(source, tmp_path / "set", part=(0, 3))
    told: list[tuple[str, int]] = []
    source.loaded.clear()
    for number in (1, 2):
        build_of(source, tmp_path / "set", part=(number, 3), note=lambda text: told.append((text, len(source.loaded))))
    assert [loaded for text, loaded in told if "look wrong" in text] == [0, 3]
    assert source.loaded == source.ids[3:]


def test_workers_tell_what_they_saw(moving: Path, tmp_path: Path) -> None:
    notes: list[str] = []
    report = build_of(open_source(moving), tmp_path / "set", workers=1, note=notes.append)
    assert report.look
    assert [note for note in notes if note.startswith(report.look)]


def test_captures_beyond_the_places_are_not_judged_but_the_last_is(monkeypatch: pytest.MonkeyPatch) -> None:
    judged: list[str] = []
    monkeypatch.setattr(first_look._Look, "at", lambda self, capture: judged.append(capture))
    look = FirstLook()
    assert [look.see(number) for number in range(12)] == [None] * 12
    look.end()
    assert judged == [0, 1, 2, 4, 8, 11]
    judged.clear()
    look = FirstLook()
    for number in range(100):
        look.see(number)
    look.end()
    assert judged == [0, 1, 2, 4, 8, 16, 32, 64]


def test_a_capture_that_cannot_be_measured_ends_the_look_without_a_word() -> None:
    look = FirstLook()
    assert look.see(frame_of(wrong=(0,)).view(0)) is None
    empty = replace(frame_of().view(0), world_from_camera=None, frame_id=None)
    assert (look.see(empty), look.see(frame_of(wrong=(0, 1))), look.end()) == (None, None, None)


def test_a_check_that_breaks_does_not_stop_who_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any) -> Any:
        raise RuntimeError("linalg")

    monkeypatch.setattr(first_look, "CHECKS", {"poses": SimpleNamespace(
        findings={first_look.POSES: (), first_look.UNIT: ()}, of=(DepthFrame,), judge=broken, memory=tuple, whole=None
    )})  # fmt: skip
    look = FirstLook()
    assert (look.see(frame_of()), look.end()) == (None, None)


def test_fuse_reads_no_capture_twice_and_tells_it_before_the_last_is_fused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = Counted(4)
    monkeypatch.setattr("pcdata.cli.fuse.open_captures", lambda *_, **__: source)
    assert main(["fuse", "somewhere", "--voxel-size", "0.02", "--out", str(tmp_path / "s.ply")]) == 0
    assert source.loaded == source.ids
    assert "fuse: the poses look wrong: " in capsys.readouterr().err
