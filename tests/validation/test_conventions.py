"""A capture of another convention is named by the option that reads it, and read so it is right; a right one is not."""

from __future__ import annotations

import functools
import itertools
from dataclasses import replace

import pytest
import torch

from pcdata import DepthFrame
from pcdata.cli.argument_types import value_of
from pcdata.functional.depth.rendered import ray_lengths
from pcdata.geometry import rigid
from pcdata.geometry.camera_axes import CAMERA_AXES
from pcdata.io.sources.convention import ConventionSource
from pcdata.validation import CaptureLimits
from pcdata.validation.checks.pose_direction import pose_direction
from pcdata.validation.measures.pose_conventions import CONVENTIONS
from pcdata.verdicts import Finding, Verdict
from tests.validation.captures import scene


class Held:
    """One capture in memory."""

    name = "held"

    def __init__(self, frame: DepthFrame) -> None:
        self.frame = replace(frame, sample_id="one")
        self.ids = ["one"]

    def __len__(self) -> int:
        return 1

    def load(self, sample_id: str) -> DepthFrame:
        return self.frame


@functools.cache
def right_capture(seed: int) -> DepthFrame:
    return scene(seed, 3).frame


def found_in(frame: DepthFrame) -> Finding:
    (found,) = pose_direction(frame, CaptureLimits(), [])
    return found


def stored(frame: DepthFrame, said: dict[str, str]) -> DepthFrame:
    """The same capture as somebody of this convention stores it."""
    pose, depth = frame.world_from_camera, frame.depth
    assert pose is not None
    pose = pose @ CAMERA_AXES[said.get("axes", "opencv")].T
    if said.get("poses") == "camera_from_world":
        pose = rigid.invert_rigid(pose)
    if said.get("depth") == "ray":
        depth = (depth * ray_lengths(frame.size, frame.camera.intrinsics, None)).float()
    if said.get("rows") == "bottom_first":
        depth = depth.flip(1)
    return replace(frame, world_from_camera=pose, depth=depth, colors=None, labels=None)


SAID = [
    {"axes": "opengl"},
    {"axes": "coppeliasim"},
    {"axes": "body"},
    {"poses": "camera_from_world"},
    {"axes": "opengl", "poses": "camera_from_world"},
    {"depth": "ray"},
    {"rows": "bottom_first"},
]


def options_in(advice: str) -> dict[str, str]:
    """Read the option of an advice as the command line does."""
    said: dict[str, str] = {}
    for flag, word in itertools.pairwise(advice.partition("read them so: ")[2].split()):
        if flag == "--convention":
            said["axes"] = word
        if flag == "--option":
            name, _, value = word.partition("=")
            said[name.removeprefix("convention.")] = value_of(value)
    return said


@pytest.mark.parametrize("said", SAID, ids=lambda said: "-".join(said.values()))
def test_a_capture_of_each_convention_is_named_and_read_as_advised_it_is_right(said: dict[str, str]) -> None:
    right = right_capture(0)
    wrong = stored(right, said)
    found = found_in(wrong)
    assert found.verdict is Verdict.FAIL
    assert options_in(found.advice) == said
    again = ConventionSource(source=Held(wrong), **options_in(found.advice)).load("one")  # type: ignore[arg-type]
    assert found_in(again).verdict is Verdict.PASS
    assert torch.allclose(again.depth, right.depth, atol=1e-6)
    assert right.world_from_camera is not None
    assert again.world_from_camera is not None
    assert torch.allclose(again.world_from_camera, right.world_from_camera, atol=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_no_convention_is_named_of_a_right_capture(seed: int) -> None:
    assert found_in(right_capture(seed)).verdict is Verdict.PASS


def test_every_option_that_is_advised_is_one() -> None:
    for name, convention in CONVENTIONS.items():
        if convention.option:
            said = options_in(f"read them so: {convention.option}")
            assert said in SAID, name
