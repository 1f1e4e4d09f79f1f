"""The laws that every operation on objects keeps, a step of fusion; a new one joins by an entry in EXAMPLES."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from pcdata.contracts.dispatch import BACKEND_MODULES, OPERATIONS, why_unavailable
from pcdata.contracts.fields import Fields
from pcdata.errors import BackendError, DeviceError, DTypeError, PcdataError, ShapeError, UnitError
from pcdata.functional import tsdf
from pcdata.functional.depth.deproject import pixel_rays
from pcdata.rng import seeded

GRID = tsdf.VoxelGrid(0.02, 0.1)
INTRINSICS = torch.tensor([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]], dtype=torch.float64)


def view(seed: int) -> tsdf.FusionView:
    """A bumpy surface a metre away, with holes, colors, labels and weights."""
    generator = seeded(seed)
    depth = 1.0 + 0.05 * torch.rand(48, 64, generator=generator)
    depth[torch.rand(48, 64, generator=generator) < 0.1] = 0.0
    rays = pixel_rays(INTRINSICS[None], (48, 64), None)[0]
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = 0.05 * seed
    return tsdf.FusionView(
        depth=depth,
        rays=rays.permute(2, 0, 1).float().contiguous(),
        pinhole=(60.0, 0.0, 31.5, 60.0, 23.5),
        distortion=None,
        world_from_camera=pose,
        weight=tsdf.weight_image(depth, rays, "inverse_square"),
        color=tsdf.pack_colors(torch.randint(256, (48, 64, 3), generator=generator, dtype=torch.uint8)),
        label=torch.randint(3, (48, 64), generator=generator, dtype=torch.int32),
    )


def blocks(num_views: int = 2) -> tsdf.VoxelBlocks:
    made = tsdf.VoxelBlocks(tsdf.voxel_planes(colors=True, labels=True, views=True), torch.device("cpu"))
    for seed in range(num_views):
        made.add(tsdf.find_blocks(made, tsdf.touched_blocks(view(seed), GRID, backend="torch"), backend="torch")[1])
    for seed in range(num_views):
        rows, _ = tsdf.find_blocks(made, tsdf.touched_blocks(view(seed), GRID, backend="torch"), backend="torch")
        tsdf.integrate_view(made, rows, view(seed), GRID, carve=True, backend="torch")
    return made


def of_blocks_and_keys() -> dict[str, Any]:
    return {"blocks": blocks(), "keys": tsdf.touched_blocks(view(3), GRID, backend="torch")}


def of_blocks_and_view() -> dict[str, Any]:
    made = blocks()
    return {"blocks": made, "rows": torch.arange(1, len(made), 2), "view": view(1), "grid": GRID, "carve": True}


def of_blocks_and_edges() -> dict[str, Any]:
    made = blocks()
    return {"blocks": made, "edge": tsdf.find_crossings(made, GRID, edges=True, backend="torch").edge}


# Operation -> what makes its arguments: equal ones at every call.
EXAMPLES: dict[str, Callable[[], dict[str, Any]]] = {
    "touched_blocks": lambda: {"view": view(0), "grid": GRID},
    "find_blocks": of_blocks_and_keys,
    "locate_views": lambda: {"blocks": blocks(), "views": [view(0), view(3), view(4)], "grid": GRID},
    "integrate_view": of_blocks_and_view,
    "find_crossings": lambda: {"blocks": blocks(), "grid": GRID, "edges": True},
    "find_triangles": of_blocks_and_edges,
}
each_operation = pytest.mark.parametrize("name", EXAMPLES)
LIVE = [backend for backend in BACKEND_MODULES if why_unavailable(backend) is None]  # asking loads the kernels


def state(value: Any) -> list[Tensor]:
    """All that a value holds: of blocks what was stored, not the indices that find it."""
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, tsdf.VoxelBlocks):
        planes = [plane[: len(value)] for chunk in value.chunks for plane in chunk.values()]
        assert len(value.chunks) == 1
        return [value.keys, *planes]
    if isinstance(value, (tuple, list)):
        return [tensor for one in value for tensor in state(one)]
    if is_dataclass(value):
        return [tensor for field in fields(value) for tensor in state(getattr(value, field.name))]
    return []


def equal(one: Any, other: Any) -> bool:
    pairs = list(zip(state(one), state(other), strict=True))
    return all(a.dtype == b.dtype and torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in pairs)


def call(name: str, arguments: dict[str, Any], backend: str = "auto") -> Any:
    return OPERATIONS[name].public(**arguments, backend=backend)


def test_every_operation_on_objects_has_an_example():
    assert set(EXAMPLES) == {name for name, operation in OPERATIONS.items() if not operation.contract.tensors_alone}


@pytest.mark.parametrize(
    ("name", "backend"),
    [(name, backend) for name in EXAMPLES for backend in ("torch", *LIVE) if OPERATIONS[name].serves(backend)],
)
def test_every_backend_gives_what_the_reference_gives_and_changes_what_it_says_alone(name, backend):
    before, expected, arguments = EXAMPLES[name](), EXAMPLES[name](), EXAMPLES[name]()
    wanted, found = call(name, expected, "torch"), call(name, arguments, backend)
    for one, other in zip(state(found), state(wanted), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)  # of whole numbers: equal
    for key, value in arguments.items():
        assert equal(value, expected[key]), key
        assert equal(value, before[key]) == (key not in OPERATIONS[name].mutates), key


@each_operation
def test_the_answer_repeats_in_any_mode_dtype_and_device_by_default(name):
    wanted, expected = EXAMPLES[name](), EXAMPLES[name]()
    answer = call(name, wanted)
    before = torch.get_default_dtype()
    try:
        torch.set_default_dtype(torch.float64)
        with torch.inference_mode(), torch.device("meta"):
            assert equal(call(name, expected), answer)
    finally:
        torch.set_default_dtype(before)
    assert equal(tuple(expected.values()), tuple(wanted.values()))


@each_operation
def test_wrong_arguments_are_refused_by_name_before_any_backend(name):
    good, contract = EXAMPLES[name](), OPERATIONS[name].contract

    def refused(key: str, bad: Any, error: type[PcdataError]) -> None:
        with pytest.raises(error, match=rf"^{name}: {key}"):
            call(name, {**good, key: bad}, "none")

    for key in contract.tensors:
        refused(key, good[key].float(), DTypeError)
        refused(key, good[key][None], ShapeError)
        refused(key, good[key].tolist(), DTypeError)
    for key, spec in contract.others.items():
        if isinstance(spec, Fields):
            refused(key, None, DTypeError)
            refused(key, "other", DTypeError)
    if "view" in good:
        refused("view", replace(good["view"], depth=good["view"].depth.double()), DTypeError)
        refused("view", replace(good["view"], color=good["view"].color[1:]), ShapeError)
        refused("view", replace(good["view"], label=good["view"].label.to("meta")), DeviceError)
    if "views" in good:
        first, second, third = good["views"]
        refused("views", [], DTypeError)
        refused("views", first, DTypeError)
        refused("views", [first, replace(second, depth=second.depth.double()), third], DTypeError)
        refused("views", [first, replace(second, world_from_camera=second.world_from_camera[0]), third], ShapeError)
        elsewhere = {name: getattr(second, name).to("meta") for name in ("depth", "rays", "weight", "color", "label")}
        refused("views", [first, replace(second, **elsewhere), third], DeviceError)
    if "blocks" in good:
        for key in contract.tensors:
            with pytest.raises(DeviceError, match=rf"^{name}: .*meta"):
                call(name, {**good, key: good[key].to("meta")})


@each_operation
def test_an_unknown_backend_is_refused(name):
    with pytest.raises(BackendError, match=rf"^{name}: unknown backend 'toch'; known: 'auto', 'torch'"):
        call(name, EXAMPLES[name](), "toch")


@pytest.mark.parametrize("backend", ["torch", "auto"])
@pytest.mark.parametrize("reading", [1e6, 1e12, 1e30, float("inf")])
def test_a_reading_beyond_all_blocks_is_refused_and_never_wraps(reading, backend):
    far = view(0)
    far.depth[3, 5] = reading
    with pytest.raises(UnitError, match=r"more than 2\^20"):
        tsdf.touched_blocks(far, GRID, backend=backend)
