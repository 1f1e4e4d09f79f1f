from __future__ import annotations

import json

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata.errors import CaptureError, DeviceError, DTypeError, NonFiniteError, ShapeError
from pcdata.functional.depth.deproject import deproject_depth
from pcdata.structures import Camera

SIZE = (48, 64)


def camera(**changes) -> Camera:
    return Camera.pinhole(**{"fx": 60.0, "fy": 61.0, "cx": 30.2, "cy": 24.9, "size": SIZE, **changes})


def ray(of: Camera, v: float, u: float) -> torch.Tensor:
    """The direction through continuous pixel coordinates, z = 1."""
    inverse = torch.linalg.inv(of.intrinsics[0])
    return inverse @ torch.tensor([u, v, 1.0], dtype=torch.float64)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 200), st.integers(1, 200), st.floats(0, 1), st.floats(0, 1))
def test_a_resized_camera_sees_every_ray_at_the_scaled_place(height, width, v, u):
    small = camera().resized((height, width))
    # Measured from the image's corner, which is at -0.5, places scale with the size.
    v0, u0 = v * SIZE[0] - 0.5, u * SIZE[1] - 0.5
    v1, u1 = v * height - 0.5, u * width - 0.5
    torch.testing.assert_close(ray(small, v1, u1), ray(camera(), v0, u0), atol=1e-12, rtol=1e-12)


def test_resizing_there_and_back_changes_nothing():
    back = camera().resized((24, 16)).resized(SIZE)
    torch.testing.assert_close(back.intrinsics, camera().intrinsics, atol=1e-12, rtol=0)


@pytest.mark.parametrize("distortion", [None, [0.1, -0.05, 0.001, 0.002, 0.01]])
def test_a_cropped_image_deprojects_to_the_same_points(distortion):
    whole = camera(distortion=distortion)
    depth = torch.rand(1, *SIZE) + 0.5
    points, _, _ = deproject_depth(depth, whole.intrinsics, distortion=whole.distortion)
    # This window does not hold the principal point.
    top, left, size = 30, 40, (15, 20)
    window = whole.cropped(top, left, size)
    part = depth[:, top : top + size[0], left : left + size[1]]
    cropped, _, _ = deproject_depth(part, window.intrinsics, distortion=window.distortion)
    expected = points.reshape(*SIZE, 3)[top : top + size[0], left : left + size[1]].reshape(-1, 3)
    torch.testing.assert_close(cropped, expected, atol=1e-6, rtol=0)
    assert window.view(0).size == size
    assert torch.equal(Camera.from_dict(json.loads(json.dumps(window.to_dict()))).intrinsics, window.intrinsics)


def test_a_window_outside_the_image_is_refused():
    for top, left, size in [(-1, 0, (4, 4)), (0, 61, (4, 4)), (45, 0, (4, 4))]:
        with pytest.raises(CaptureError, match="leaves the image"):
            camera().cropped(top, left, size)
    with pytest.raises(CaptureError, match="at least one pixel"):
        camera().cropped(0, 0, (0, 4))


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"fx": -60.0}, CaptureError, "focal lengths must be positive.*simulator"),
        ({"fy": 0.0}, CaptureError, "focal lengths must be positive"),
        ({"cx": 64.0}, CaptureError, r"principal point \(64, 24.9\) lies outside.*Camera.resized"),
        ({"cy": -1.0}, CaptureError, "lies outside the 64x48 image"),
        ({"fx": float("nan")}, NonFiniteError, "NaN"),
        ({"size": (0, 64)}, CaptureError, "at least one pixel"),
        ({"size": (48.0, 64.0)}, CaptureError, "at least one pixel"),
    ],
)
def test_intrinsics_that_cannot_be_are_refused(changes, error, message):
    with pytest.raises(error, match=message):
        camera(**changes)


def test_matrices_of_another_form_are_refused():
    good = camera().intrinsics
    transposed = good.mT.contiguous()
    with pytest.raises(CaptureError, match=r"must be \[\[fx, s, cx\]"):
        Camera(intrinsics=transposed, size=SIZE)
    with pytest.raises(DTypeError, match="must be float64"):
        Camera(intrinsics=good.float(), size=SIZE)
    with pytest.raises(ShapeError, match=r"V, 3, 3"):
        Camera(intrinsics=good[0], size=SIZE)
    with pytest.raises(ShapeError, match="at least one view"):
        Camera(intrinsics=good[:0], size=SIZE)
    with pytest.raises(ShapeError, match="V=2 but intrinsics has V=1"):
        Camera(intrinsics=good, size=SIZE, distortion=torch.zeros(2, 5, dtype=torch.float64))
    with pytest.raises(DeviceError, match="distortion is on meta"):
        Camera(intrinsics=good, size=SIZE, distortion=torch.zeros(1, 5, dtype=torch.float64, device="meta"))


def test_a_size_given_as_a_list_is_the_same_size():
    assert Camera(intrinsics=camera().intrinsics, size=[48, 64]).size == SIZE


def test_views_are_cameras_of_their_own():
    two = Camera(intrinsics=torch.cat([camera().intrinsics, camera(fx=70.0).intrinsics]), size=SIZE)
    assert two.num_views == 2
    assert float(two.view(1).intrinsics[0, 0, 0]) == 70.0
    for index in (-1, 2):
        with pytest.raises(ShapeError, match=f"no view {index}; views count from 0 to 1"):
            two.view(index)


@pytest.mark.parametrize("distortion", [None, [0.1, 0.2, 0.3, 0.4, 0.5]])
def test_plain_numbers_bring_the_camera_back_exactly(distortion):
    original = camera(fx=60.123456789012345, distortion=distortion)
    back = Camera.from_dict(json.loads(json.dumps(original.to_dict())))
    assert torch.equal(back.intrinsics, original.intrinsics)
    assert back.size == original.size
    assert (back.distortion is None) == (distortion is None)
    assert distortion is None or torch.equal(back.distortion, original.distortion)
    assert "64x48" in repr(back)
