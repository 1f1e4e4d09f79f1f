"""Captures of simulators' conventions: converted, they are those of a camera here; and the way back is the same."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pcdata import DepthFrame, open_source
from pcdata.errors import CaptureError, ConfigError, DTypeError
from pcdata.functional.depth.rendered import ray_lengths, z_of_rendered
from pcdata.geometry.camera_axes import CAMERA_AXES
from pcdata.geometry.rigid import invert_rigid
from pcdata.synthetic import SyntheticSource
from tests.captures import cloud_files

NEAR, FAR = 0.02, 20.0


def scene() -> DepthFrame:
    return SyntheticSource(num_scenes=1, num_objects=2, size=(24, 32)).load("tabletop-0000")


def written(root: Path, frame: DepthFrame, values: np.ndarray, pose: torch.Tensor, **changes: Any) -> Path:
    """One view as the layout 'folder', its numbers as they are given."""
    (fx, _, cx), (_, fy, cy), _ = frame.camera.intrinsics[0].tolist()
    for name in ("depth", "poses"):
        (root / name).mkdir(parents=True, exist_ok=True)
    np.save(root / "depth" / "0.npy", values.astype(np.float32))
    (root / "poses" / "0.txt").write_text("\n".join(" ".join(map(repr, row)) for row in pose.tolist()))
    k = {"width": 32, "height": 24, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "metres_per_unit": 1.0, "frame_id": "world"}
    (root / "intrinsics.json").write_text(json.dumps(k | changes))
    return root


def first_view() -> tuple[DepthFrame, torch.Tensor]:
    frame = scene().view(0)
    assert frame.world_from_camera is not None
    return frame, frame.world_from_camera[0]


@pytest.mark.parametrize("axes", CAMERA_AXES)
def test_a_pose_of_any_axes_is_that_of_a_camera_here(axes: str, tmp_path: Path) -> None:
    frame, pose = first_view()
    stored = pose @ CAMERA_AXES[axes].T  # the pose of the other camera: OpenCV's axes are its own turned
    path = written(tmp_path, frame, frame.depth[0].numpy(), stored)
    found = open_source(path, convention={"axes": axes}).load("0")
    assert torch.allclose(found.world_from_camera[0], pose, atol=1e-12)
    path = written(tmp_path, frame, frame.depth[0].numpy(), invert_rigid(stored))
    found = open_source(path, convention={"axes": axes, "poses": "camera_from_world"}).load("0")
    assert torch.allclose(found.world_from_camera[0], pose, atol=1e-12)
    assert torch.equal(found.depth, frame.depth)


AXES_IN_WORDS = {
    "opencv": "x right, y down, z forward",
    "opengl": "x right, y up, z backwards",
    "coppeliasim": "x left, y up, z forward",
    "body": "x forward, y left, z up",
}


def test_axes_are_turns_that_lead_to_what_their_words_say() -> None:
    assert CAMERA_AXES.keys() == AXES_IN_WORDS.keys()
    for name, words in AXES_IN_WORDS.items():
        matrix = CAMERA_AXES[name][:3, :3]
        assert torch.linalg.det(matrix) == pytest.approx(1.0)
        seen = dict(zip(("right", "down", "forward"), matrix.T))  # in the axes of the other
        seen |= {"left": -seen["right"], "up": -seen["down"], "backwards": -seen["forward"]}
        for axis, told in enumerate(words.split(", ")):
            letter, direction = told.split()
            assert letter == "xyz"[axis]
            assert seen[direction].tolist() == np.eye(3)[axis].tolist()


def rendered_of_z(depth: torch.Tensor, kind: str, near: float, far: float) -> torch.Tensor:
    """What a renderer stores of depth: shares of the range, the far plane where nothing is."""
    z = torch.where(depth > 0, depth.double(), far).clamp(near, far)
    return (1 - near / z) / (1 - near / far) if kind == "z_buffer" else (z - near) / (far - near)


@pytest.mark.parametrize("kind", ["ray", "z_buffer", "equal_steps"])
def test_depth_of_any_kind_is_z_and_the_far_plane_is_no_reading(kind: Any, tmp_path: Path) -> None:
    frame, pose = first_view()
    z = frame.depth[0].clone()
    z[0, :3] = 0.0
    planes: dict[str, Any] = {} if kind == "ray" else {"near": NEAR, "far": FAR}
    if kind == "ray":
        values = z * ray_lengths(frame.size, frame.camera.intrinsics, None)[0]
    else:
        values = rendered_of_z(z, kind, NEAR, FAR)
        assert (values[0, :3] == 1.0).all()
    found = open_source(written(tmp_path, frame, values.numpy(), pose), convention={"depth": kind, **planes}).load("0")
    assert torch.equal(found.depth[0] == 0, z == 0)
    # A buffer of float32 holds z to this near 1 m: steps of 6e-8 of 1, times z^2 / near.
    assert (found.depth[0] - z).abs().max() < 2e-4
    assert found.provenance["convention"]["depth"] == kind


def test_a_buffer_in_whole_numbers_is_read_by_its_highest_number(tmp_path: Path) -> None:
    frame, pose = first_view()
    path = written(tmp_path, frame, frame.depth[0].numpy(), pose, metres_per_unit=1 / 65535)
    share = rendered_of_z(frame.depth[0], "equal_steps", NEAR, 6.0)
    (path / "depth" / "0.npy").unlink()
    np.save(path / "depth" / "0.npy", (share * 65535).round().numpy().astype(np.uint16))
    found = open_source(path, convention={"depth": "equal_steps", "near": NEAR, "far": 6.0}).load("0")
    assert (found.depth - frame.depth).abs().max() < 6.0 / 65535
    assert "metres_per_unit" not in found.provenance, "the numbers were shares, so no check may take them for lengths"


def test_rows_from_the_bottom_and_pixels_counted_from_corners_are_put_right(tmp_path: Path) -> None:
    frame, pose = first_view()
    (_, _, cx), (_, _, cy), _ = frame.camera.intrinsics[0].tolist()
    path = written(tmp_path, frame, frame.depth[0].flip(0).numpy(), pose, cx=cx + 0.5, cy=cy + 0.5)
    found = open_source(path, convention={"rows": "bottom_first", "principal_point": "corner"}).load("0")
    assert torch.equal(found.depth, frame.depth)
    assert torch.equal(found.camera.intrinsics, frame.camera.intrinsics)


@pytest.mark.parametrize(
    ("said", "error", "words"),
    [
        ({"axes": "open_gl"}, ConfigError, "did you mean 'opengl'"),
        ({"depth": "z_buffer"}, ConfigError, "near and far in metres with 0 < near < far, got 0 and 0"),
        ({"depth": "z_buffer", "near": 2.0, "far": 1.0}, ConfigError, "0 < near < far"),
        ({"near": 0.1, "far": 2.0}, ConfigError, "are of depth = z_buffer or equal_steps"),
        ({"depth": "z_buffer", "near": 0.1, "far": 2.0}, CaptureError, "shares from 0 to 1, but this one reaches"),
    ],
)
def test_a_convention_that_cannot_be_is_refused(said: Any, error: type, words: str, tmp_path: Path) -> None:
    frame, pose = first_view()
    path = written(tmp_path, frame, 3.0 * frame.depth[0].numpy(), pose)
    with pytest.raises(error, match=words):
        open_source(path, convention=said).load("0")


def test_what_has_no_poses_or_no_depth_says_so(tmp_path: Path) -> None:
    frame, pose = first_view()
    path = written(tmp_path / "a", frame, frame.depth[0].numpy(), pose)
    (path / "poses" / "0.txt").unlink()
    (path / "poses").rmdir()
    with pytest.raises(CaptureError, match="has no pose; leave out axes and poses"):
        open_source(path, convention={"axes": "opengl"}).load("0")
    with pytest.raises(DTypeError, match="converts depth frames"):
        open_source(cloud_files(tmp_path / "b"), convention={"rows": "bottom_first"}).load("a")


def test_shares_become_the_lengths_that_the_formulas_of_the_simulators_give() -> None:
    share = torch.tensor([[0.0, 0.5, 0.99, 1.0]])
    z = z_of_rendered("test", share, "z_buffer", 0.1, 10.0)[0]
    expected = 0.1 / (1 - share[0].double() * (1 - 0.1 / 10))
    assert z[:3].tolist() == pytest.approx(expected[:3].tolist())
    assert z[3] == 0
    assert z_of_rendered("test", share, "equal_steps", 0.1, 10.1)[0, :3].tolist() == pytest.approx([0.1, 5.1, 10.0])
    for wrong in (torch.tensor([[float("nan")]]), torch.tensor([[-0.1]])):
        with pytest.raises(CaptureError, match="shares from 0 to 1"):
            z_of_rendered("test", wrong, "z_buffer", 0.1, 10.0)
