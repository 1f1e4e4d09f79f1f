"""The compiled image kernels give the reference's results bit for bit."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from pcdata.contracts.dispatch import INNER, why_unavailable
from pcdata.functional.depth.deproject import Deprojected
from pcdata.functional.depth.looks import look_at_depth
from pcdata.geometry import rigid
from pcdata.rng import seeded

REASON = why_unavailable("cpu")
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))

K = torch.tensor([[[30.0, 0.0, 8.2], [0.0, 31.0, 6.1], [0.0, 0.0, 1.0]]], dtype=torch.float64)
SKEWED = K + torch.tensor([[0.0, 0.3, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
LENS = torch.tensor([[0.05, -0.02, 0.001, -0.002, 0.01]], dtype=torch.float64)


def depth_image(views: int = 3, size: tuple[int, int] = (13, 37), *, holes: float = 0.3, seed: int = 0) -> Tensor:
    generator = seeded(seed)
    depth = 0.3 + torch.rand(views, *size, generator=generator)
    return torch.where(torch.rand(depth.shape, generator=generator) < holes, 0.0, depth)


def companions(depth: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    generator = seeded(7)
    colors = torch.randint(256, (*depth.shape, 3), generator=generator, dtype=torch.uint8)
    images = {
        "labels": torch.randint(-1, 9, depth.shape, generator=generator),
        "confidence": torch.randint(256, depth.shape, generator=generator, dtype=torch.uint8),
        "flow": torch.rand(*depth.shape, 2, generator=generator, dtype=torch.float64),
    }
    return colors, images


def poses(views: int) -> Tensor:
    quaternion = torch.randn(views, 4, generator=seeded(3), dtype=torch.float64)
    offset = 0.2 * torch.rand(views, 3, generator=seeded(4))
    return rigid.from_rotation_translation(rigid.rotation_from_quaternion(quaternion), offset)


def both(name: str, *args: Any, **options: Any) -> tuple[Any, Any]:
    """The kernel's result and the reference's."""
    return INNER[name].kernels["cpu"](*args, **options), INNER[name].reference(*args, **options)


def region(lower: Any, upper: Any, *, matrix: Any = None, near: Any = None, far: Any = None, mask: Any = None) -> Any:
    return {"lower": lower, "upper": upper, "matrix": matrix, "near": near, "far": far, "mask": mask}


def assert_same(ours: Any, theirs: Any) -> None:
    assert type(ours) is type(theirs)
    if isinstance(theirs, Tensor):
        assert ours.dtype == theirs.dtype
        assert torch.equal(ours, theirs)
    elif isinstance(theirs, Deprojected):
        assert_same(dataclasses.asdict(ours), dataclasses.asdict(theirs))
    elif isinstance(theirs, dict):
        assert list(ours) == list(theirs)
        assert_same(list(ours.values()), list(theirs.values()))
    elif isinstance(theirs, (list, tuple)):
        for one, other in zip(ours, theirs, strict=True):
            assert_same(one, other)
    else:
        assert ours == theirs


@pytest.mark.parametrize(("near", "far"), [(None, None), (0.7, None), (None, 0.9), (0.5, 1.0)])
@pytest.mark.parametrize("masked", [False, True])
def test_masked_depth_equals_the_reference(near, far, masked):
    depth = depth_image()
    mask = torch.rand(depth.shape, generator=seeded(1)) < 0.6 if masked else None
    assert_same(*both("mask_depth", depth, near, far, mask))


def test_limits_are_compared_as_float32_like_the_reference_does():
    limit = 0.7  # lies between two float32 values
    around = np.float32(limit) + np.arange(-3, 4) * np.spacing(np.float32(limit))
    depth = torch.from_numpy(around.astype(np.float32)).reshape(1, 1, 7)
    ours, theirs = both("mask_depth", depth, limit, None, None)
    assert torch.equal(ours, theirs)
    assert 0 < int((theirs > 0).sum()) < 7
    assert_same(*both("mask_depth", depth, None, limit, None))


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("holes", [0.0, 0.3, 0.97, 1.0])
@pytest.mark.parametrize("camera", [(K, None), (SKEWED, None), (K, LENS)], ids=["pinhole", "skewed", "lens"])
def test_points_and_companions_equal_the_reference(camera, holes, threads):
    depth = depth_image(holes=holes, size=(40, 33))
    intrinsics, distortion = (None if one is None else one.repeat(3, 1, 1)[:, : len(one[0])] for one in camera)
    if distortion is not None:
        distortion = LENS.repeat(3, 1)
    colors, images = companions(depth)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        assert_same(*both("deproject_images", depth, intrinsics, distortion, colors, images))
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("size", [(0, 5), (5, 0), (1, 1), (1, 7), (7, 1)], ids=str)
@pytest.mark.parametrize("distortion", [None, LENS.repeat(2, 1)], ids=["pinhole", "lens"])
def test_images_of_any_size_equal_the_reference(distortion, size):
    depth = depth_image(2, size)
    colors, images = companions(depth)
    cameras = depth, K.repeat(2, 1, 1), distortion
    assert_same(*both("mask_depth", depth, 0.4, None, None))
    assert_same(*both("deproject_images", *cameras, colors, images))
    assert_same(*both("deproject_into_box", *cameras, colors, images, **region((-1.0,) * 3, (1.0,) * 3)))


def test_all_256_colors_equal_the_reference():
    depth = torch.ones(1, 16, 16)
    colors = torch.arange(256, dtype=torch.uint8).reshape(1, 16, 16, 1).expand(-1, -1, -1, 3)
    assert_same(*both("deproject_images", depth, K, None, colors, {}))


@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("camera", [(K, None), (SKEWED, None), (K, LENS)], ids=["pinhole", "skewed", "lens"])
def test_a_box_equals_the_reference(camera, moved):
    depth = depth_image()
    views = len(depth)
    intrinsics, distortion = camera[0].repeat(views, 1, 1), None if camera[1] is None else camera[1].repeat(views, 1)
    colors, images = companions(depth)
    mask = torch.rand(depth.shape, generator=seeded(1)) < 0.8
    matrix = poses(views) if moved else None
    box = ((-0.3, -0.2, -0.4), (0.4, 0.3, 1.1))
    cameras = depth, intrinsics, distortion
    everything = region(*box, matrix=matrix, near=0.35, far=1.2, mask=mask)
    ours, theirs = both("deproject_into_box", *cameras, colors, images, **everything)
    assert_same(ours, theirs)
    assert 0 < len(theirs[0].points) < int(theirs[1].sum())
    assert_same(*both("deproject_into_box", *cameras, None, {}, **region(*box, matrix=matrix)))
    depth = 0.4 + depth.round(decimals=1)  # with surfaces, and readings that are none beside them
    depth[:, ::3, ::5], depth[:, 1, 1:4] = 0.0, torch.tensor([math.nan, math.inf, -1.0])
    for flying in ((0.02, 3), (0.3, 8)):
        for limits in ({}, {"near": 0.5, "far": 1.2, "mask": mask.mT.contiguous().mT}):
            limited = region(*box, matrix=matrix, **limits)
            ours, theirs = both("deproject_into_box", depth, *cameras[1:], colors, images, **limited, flying=flying)
            assert_same(ours, theirs)


def test_a_point_on_a_face_is_inside():
    depth = torch.ones(1, 3, 3)
    camera = torch.eye(3, dtype=torch.float64)[None]
    camera[:, :2, 2] = 1.0  # the pixels see x and y at -1, 0, 1
    box = region((-1.0, 0.0, 1.0), (0.0, 1.0, 1.0))
    ours, theirs = both("deproject_into_box", depth, camera, None, None, {}, **box)
    assert_same(ours, theirs)
    assert ours[0].points[:, :2].tolist() == [[-1.0, 0.0], [0.0, 0.0], [-1.0, 1.0], [0.0, 1.0]]


def test_points_that_overflow_are_left_to_the_reference():
    depth = torch.full((1, 2, 2), 1e30)
    huge = torch.diag(torch.tensor([1e20, 1.0, 1.0, 1.0], dtype=torch.float64))[None]
    box = region((-1.0,) * 3, (math.inf,) * 3, matrix=huge)
    ours, theirs = both("deproject_into_box", depth, K, None, None, {}, **box)
    assert ours is None
    assert theirs is None


@pytest.mark.parametrize("bad", [-0.5, math.nan])
def test_a_depth_that_cannot_be_gets_the_reference_s_error(bad):
    depth = depth_image()
    depth[1, 2, 3] = bad
    args = (depth, K.repeat(3, 1, 1), None, None, {})
    with pytest.raises(ValueError, match="deproject_depth") as theirs:
        INNER["deproject_images"].reference(*args)
    with pytest.raises(type(theirs.value)) as ours:
        INNER["deproject_images"].kernels["cpu"](*args)
    assert str(ours.value) == str(theirs.value)


def test_gradients_reach_the_depth():
    from pcdata.functional.depth.deproject import deproject_images

    depth = depth_image().requires_grad_()
    deproject_images(depth, K.repeat(3, 1, 1), None, None, {}).points.sum().backward()
    assert int((depth.grad != 0).sum()) == int((depth > 0).sum())


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 3, 7), (1, 300, 301)])
def test_a_look_at_depth_is_the_references(shape):
    depth = torch.rand(shape, generator=seeded(5)) + 0.1
    last = depth.flatten()[-1:]
    others = {"none": None, "itself": depth, "equal": depth.clone(), "near": depth + 1e-6, "far": torch.zeros(shape)}
    others["last"] = torch.cat([depth.flatten()[:-1], last + 1]).reshape(shape)
    for spoilt in (None, 0.0, -0.0, -1.0, torch.nan, torch.inf):
        depth.flatten()[-1] = last if spoilt is None else spoilt
        for name, other in others.items():
            ours, theirs = (look_at_depth(depth, other, backend=backend) for backend in ("cpu", "torch"))
            assert ours.is_same == theirs.is_same, name
            np.testing.assert_array_equal([ours.least, ours.largest], [theirs.least, theirs.largest])
        copy = torch.zeros_like(depth)
        look_at_depth(depth, None, copy, backend="cpu")
        assert torch.equal(copy.nan_to_num(7), depth.nan_to_num(7))
    crossed = depth.nan_to_num(1, 1).mT
    assert look_at_depth(crossed, crossed.contiguous(), backend="cpu").is_same
    with pytest.raises(ValueError, match="beside"):
        look_at_depth(depth, torch.zeros(3), backend="cpu")
