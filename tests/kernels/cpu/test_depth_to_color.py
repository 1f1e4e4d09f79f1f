"""The compiled registration of depth to color gives the reference's images bit for bit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from pcdata.contracts.dispatch import OPERATIONS, why_unavailable
from pcdata.errors import CaptureError
from pcdata.functional.depth.depth_to_color import RegisteredDepth
from pcdata.geometry import rigid
from pcdata.rng import seeded

REASON = why_unavailable("cpu")
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))

OPERATION = OPERATIONS["register_depth"]
DEPTH_LENS = [0.05, -0.02, 0.001, -0.002, 0.01]
COLOR_LENSES = {
    "pinhole": None,
    "four coefficients": [-0.1, 0.02, 0.001, -0.002],
    "folding inside the image": [-0.9, 0.0, 0.0, 0.0, 0.0],
    "twelve coefficients": [0.1, -0.2, 0.003, -0.001, 0.05, 0.02, -0.1, 0.03, 0.001, -0.002, 0.003, 0.001],
}
POSES = {
    "the same place": ((0.0, 0.0, 1.0), 0.0, (0.0, 0.0, 0.0)),
    "beside": ((0.0, 0.0, 1.0), 0.02, (-0.05, 0.002, 0.003)),
    "lying": ((0.0, 0.0, 1.0), 1.5, (0.0, 0.03, 0.0)),
    "across": ((0.2, 1.0, 0.1), 0.7, (-0.5, 0.0, 0.2)),
    "among the readings": ((1.0, 0.3, 0.0), 0.1, (0.0, 0.0, -0.7)),
    "turned away": ((0.0, 1.0, 0.0), 3.1, (0.0, 0.0, 0.0)),
    "far aside": ((0.0, 0.0, 1.0), 0.0, (5.0, 0.0, 0.0)),
}
SIZES = {"as large": (70, 90), "three times as large": (210, 270), "a third": (23, 31), "one pixel": (1, 1)}


def scene(views: int, size: tuple[int, int], *, holes: float = 0.2, seed: int = 0) -> Tensor:
    """A slanted, rough wall with plates before it and holes in both."""
    generator = seeded(seed)
    height, width = size
    depth = 1.0 + 0.3 * torch.linspace(0, 1, width) + 0.01 * torch.rand(views, height, width, generator=generator)
    for _ in range(4):
        top, left = (int(torch.randint(0, extent, (1,), generator=generator)) for extent in size)
        depth[:, top : top + height // 3, left : left + width // 3] *= float(torch.rand(1, generator=generator)) + 0.2
    return torch.where(torch.rand(depth.shape, generator=generator) < holes, 0.0, depth)


def camera(views: int, size: tuple[int, int], *, skew: float = 0.0) -> Tensor:
    """Each view's focal length is another."""
    height, width = size
    k = torch.tensor([[0.9 * width, skew, 0.48 * width], [0, 0.92 * width, 0.51 * height], [0, 0, 1]])
    matrices = k.double().repeat(views, 1, 1)
    matrices[:, 0, 0] *= 1 + 0.1 * torch.arange(views)
    return matrices


def moved(views: int, axis: Any, angle: float, shift: Any) -> Tensor:
    turn = rigid.rotation_about_axis(torch.tensor(axis) / torch.tensor(axis).norm(), torch.tensor(angle))
    return rigid.from_rotation_translation(turn, torch.tensor(shift, dtype=torch.float64)).repeat(views, 1, 1)


def lens(views: int, coefficients: list[float] | None) -> Tensor | None:
    return None if coefficients is None else torch.tensor([coefficients], dtype=torch.float64).repeat(views, 1)


def arguments(depth: Tensor, size: tuple[int, int], color_from_depth: Tensor, **others: Any) -> dict[str, Any]:
    """Two cameras without distortion that look at a depth image, unless others are given."""
    views = len(depth)
    usual = {
        "intrinsics": camera(views, (depth.shape[1], depth.shape[2])),
        "color_intrinsics": camera(views, size),
        "distortion": None,
        "color_distortion": None,
        "max_jump": 0.02,
    }
    return {"depth": depth, "color_size": size, "color_from_depth": color_from_depth, **usual, **others}


@contextmanager
def threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def assert_same(case: dict[str, Any]) -> RegisteredDepth:
    """Compare with the reference; the kernel must not have called it."""
    wanted = OPERATION.reference(**case)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(OPERATION, "reference", lambda *_, **__: pytest.fail("the kernel fell back to the reference"))
        found = OPERATION.kernels["cpu"](**case)
    for name, one, other in zip(RegisteredDepth._fields, found, wanted, strict=True):
        assert one.dtype == other.dtype, name
        assert torch.equal(one, other), name
    return wanted


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
@pytest.mark.parametrize("pose", POSES.values(), ids=POSES)
def test_every_image_equals_the_references_bit_for_bit(pose, size, count):
    with threads(count):
        assert_same(arguments(scene(2, (70, 90)), size, moved(2, *pose)))


def test_the_scenes_hold_what_the_kernel_must_decide():
    beside = assert_same(arguments(scene(2, (70, 90)), (70, 90), moved(2, *POSES["beside"])))
    assert bool(beside.occluding.any())
    assert bool(beside.hidden.any())
    assert 0.3 < float((beside.depth > 0).float().mean()) < 1
    among = assert_same(arguments(scene(1, (70, 90)), (70, 90), moved(1, *POSES["among the readings"])))
    assert int((among.depth > 0).sum()) > 0, "some readings are before the camera, others behind"
    away = assert_same(arguments(scene(1, (70, 90)), (70, 90), moved(1, *POSES["turned away"])))
    assert not bool(away.depth.any())


@pytest.mark.parametrize("distortion", [None, DEPTH_LENS], ids=["pinhole", "depth lens"])
@pytest.mark.parametrize("skew", [0.0, 0.4])
@pytest.mark.parametrize("color_lens", COLOR_LENSES.values(), ids=COLOR_LENSES)
def test_lenses_and_skewed_cameras_equal_the_reference(color_lens, skew, distortion):
    size = (50, 60)
    case = arguments(
        scene(2, (40, 55)),
        size,
        moved(2, *POSES["beside"]),
        intrinsics=camera(2, (40, 55), skew=skew),
        color_intrinsics=camera(2, size, skew=-skew),
        distortion=lens(2, distortion),
        color_distortion=lens(2, color_lens),
    )
    assert bool(assert_same(case).depth.any())


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 2), (64, 3), (65, 3), (129, 2)], ids=str)
@pytest.mark.parametrize("holes", [0.0, 0.9, 1.0])
def test_depth_images_of_any_size_and_emptiness_equal_the_reference(size, holes):
    assert_same(arguments(scene(3, size, holes=holes), (20, 30), moved(3, *POSES["beside"])))


@pytest.mark.parametrize("size", [(0, 5), (5, 0)], ids=str)
def test_depth_images_without_pixels_give_empty_images(size):
    case = arguments(torch.zeros(2, *size), (4, 6), moved(2, *POSES["beside"]))
    case["intrinsics"] = camera(2, (5, 5))
    found = OPERATION.kernels["cpu"](**case)
    assert found.depth.shape == (2, 4, 6)
    assert not bool(found.depth.any())
    assert bool((found.pixel_index == -1).all())


def test_equally_near_readings_leave_the_first_on_any_number_of_threads():
    depth = torch.ones(1, 300, 40)  # many readings for every color pixel
    case = arguments(depth, (5, 4), torch.eye(4, dtype=torch.float64)[None])
    for count in (1, 2, 4):
        with threads(count):
            assert_same(case)


def test_a_reading_just_before_the_camera_covers_the_image():
    depth = torch.full((1, 20, 30), 2.0)
    depth[0, 10, 14] = 0.9901  # beside the axis, 0.1 mm before the color camera
    result = assert_same(arguments(depth, (40, 60), moved(1, (0.0, 0.0, 1.0), 0.0, (0.0, 0.0, -0.99))))
    assert bool((result.pixel_index == 10 * 30 + 14).all())


def test_what_floats_cannot_hold_is_the_references_to_answer(monkeypatch):
    depth = torch.full((1, 3, 3), 1e36)
    case = arguments(depth, (3, 3), moved(1, (0.0, 1.0, 0.0), 1.5, (0.0, 0.0, 0.0)))
    case["color_intrinsics"] = camera(1, (3, 3)) * torch.tensor([1e32, 1.0, 1.0])[:, None]
    called = []
    monkeypatch.setattr(OPERATION, "reference", lambda *_, **given: called.append(given))
    OPERATION.kernels["cpu"](**case)
    assert len(called) == 1


def test_a_reading_without_a_ray_is_refused_as_by_the_reference():
    folding = lens(1, [-2.0, 0.0, 0.0, 0.0, 0.0])
    case = arguments(torch.ones(1, 20, 30), (20, 30), moved(1, *POSES["beside"]), distortion=folding)
    for body in (OPERATION.kernels["cpu"], OPERATION.reference):
        with pytest.raises(CaptureError, match="cannot be inverted at"):
            body(**case)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    size=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    color_size=st.tuples(st.integers(1, 60), st.integers(1, 60)),
    axis=st.tuples(*[st.floats(-1, 1)] * 2, st.floats(0.125, 1)),
    angle=st.floats(-3.2, 3.2),
    shift=st.tuples(*[st.floats(-1, 1)] * 3),
    max_jump=st.floats(1e-4, 1.0),
    count=st.integers(1, 2),
)
def test_any_two_cameras_equal_the_reference(seed, size, color_size, axis, angle, shift, max_jump, count):
    depth = scene(1, size, seed=seed)
    with threads(count):
        assert_same(arguments(depth, color_size, moved(1, axis, angle, shift), max_jump=max_jump))
