"""Focal lengths of another sensor or size are named by several views; right ones are not blamed for wrong poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pcdata import open_source, validate_source
from pcdata.structures import DepthFrame
from pcdata.synthetic import tabletop
from pcdata.validation import CHECKS, WHOLE, CaptureLimits
from pcdata.validation.first_look import first_fault
from pcdata.validation.measures.pose_conventions import CONVENTIONS, posed_views
from pcdata.verdicts import Finding, Verdict
from tests.validation.captures import Frames, verdicts

RATIOS = (0.5, 0.65, 0.8, 1.25, 1.6, 2.0)


def with_focal(frame: DepthFrame, ratio: float, views: Sequence[int] | None = None) -> DepthFrame:
    k = frame.camera.intrinsics.clone()
    k[list(views) if views is not None else slice(None), :2, :2] *= ratio
    return replace(frame, camera=replace(frame.camera, intrinsics=k))


def rig(num_views: int = 3, seed: int = 3) -> DepthFrame:
    return tabletop(seed, num_objects=5, num_views=num_views, size=(120, 160)).frame


def of_views(frame: DepthFrame) -> list[Finding]:
    return CHECKS["focal_length"].judge(frame, CaptureLimits(), ())


def over_time(frames: Sequence[DepthFrame]) -> list[Finding]:
    check = CHECKS["focal_length_over_time"]
    memory = check.memory()
    for frame in frames:
        assert check.judge(frame, CaptureLimits(), (), *memory) == []
    assert check.whole is not None
    return check.whole(*memory, CaptureLimits())


@pytest.mark.parametrize("ratio", RATIOS)
def test_a_rig_of_wrong_focal_lengths_is_told_with_the_right_ones(ratio: float) -> None:
    right = rig()
    (found,) = of_views(with_focal(right, ratio))
    assert found.verdict is Verdict.FAIL
    assert found.view is None
    fx = float(found.found.split("fx some ")[1].split()[0])
    assert fx == pytest.approx(float(right.camera.intrinsics[0, 0, 0]), rel=0.11)


@pytest.mark.parametrize("ratio", [0.5, 0.7, 1.5])
def test_one_camera_of_a_rig_is_named(ratio: float) -> None:
    (found,) = of_views(with_focal(rig(), ratio, views=[1]))
    assert (found.verdict, found.view) == (Verdict.FAIL, 1)


@pytest.mark.parametrize("seed", range(4))
def test_right_focal_lengths_get_no_word(seed: int) -> None:
    assert of_views(rig(seed=seed)) == []
    assert first_fault([rig(seed=seed)]) is None


@pytest.mark.parametrize("name", CONVENTIONS)
@pytest.mark.parametrize("turned", [(0, 1, 2), (1,)])
def test_wrong_poses_are_not_blamed_on_the_intrinsics(name: str, turned: tuple[int, ...]) -> None:
    right = rig()
    views = [CONVENTIONS[name].read(v) if n in turned else v for n, v in enumerate(posed_views(right))]
    wrong = replace(
        right,
        world_from_camera=torch.cat([view.world_from_camera for view in views]),
        depth=torch.cat([view.depth for view in views]),
    )
    assert of_views(wrong) == []


@pytest.mark.parametrize("factor", [1e-3, 1e-2, 0.1, 10.0, 1e2, 1e3])
@pytest.mark.parametrize("seed", [3, 4])
def test_translations_in_other_units_are_not_blamed_on_the_intrinsics(factor: float, seed: int) -> None:
    wrong = rig(seed=seed)
    assert wrong.world_from_camera is not None
    poses = wrong.world_from_camera.clone()
    poses[:, :3, 3] *= factor
    assert of_views(replace(wrong, world_from_camera=poses)) == []


def test_one_view_and_views_without_poses_say_nothing() -> None:
    one = rig(1)
    assert of_views(one) == []
    assert of_views(replace(rig(), world_from_camera=None, frame_id=None)) == []
    assert over_time([one, one, one]) == []  # it has not moved


@pytest.mark.parametrize("ratio", RATIOS)
def test_a_moving_camera_tells_its_focal_length(ratio: float) -> None:
    frames = posed_views(rig(4))
    (found,) = over_time([with_focal(view, ratio) for view in frames])
    assert found.verdict is Verdict.FAIL
    assert "captures and those before them" in found.found
    reports = {one.sample_id: one for one in validate_source(Frames([with_focal(view, ratio) for view in frames]))}
    assert Verdict.FAIL in verdicts(reports[WHOLE].findings, "focal_length")


@pytest.mark.parametrize(("layout", "count"), [("seven_scenes", 12), ("apc_multiview_shelf", 12), ("open3d_rgbd", 5)])
def test_real_recordings(test_data: Path, layout: str, count: int) -> None:
    source = open_source(test_data / layout)
    frames = [source.load(name) for name in source.ids[:count]]
    assert all(one.verdict is Verdict.PASS for one in over_time(frames))
    if layout != "open3d_rgbd":  # which hardly moves: every focal length agrees
        for ratio in (0.5, 2.0):
            (found,) = over_time([with_focal(frame, ratio) for frame in frames])
            assert found.verdict is Verdict.FAIL
            assert f"about {1 / ratio:.2g} times" in found.found


def test_builds_look_at_intrinsics_before_poses() -> None:
    right = rig()
    found = first_fault([with_focal(right, 0.5)])
    assert found is not None
    assert found.name == "focal_length"
    camera = right.camera.resized((60, 80))  # the intrinsics of an image half as large
    found = first_fault([replace(right, camera=replace(camera, size=right.size))], by_pose=False)
    assert found is not None
    assert found.name == "principal_point"
