"""Fusion on a GPU: the reference's field and surface, whatever comes first, and however wild the views are."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from pcdata.contracts.dispatch import why_unavailable
from pcdata.errors import CaptureError, UnitError
from pcdata.functional import tsdf
from pcdata.functional.tsdf.grid import pack_keys
from pcdata.rng import seeded
from pcdata.structures import TSDFVolume
from tests import pretend_device
from tests.factories import assert_same, tabletop_frame
from tests.functional.tsdf.test_step_contract import EXAMPLES, GRID, blocks, call, equal, state, view
from tests.functional.tsdf.test_volume import KINDS, assert_same_volume, frame_of, random_frame, volume_of
from tests.kernels.cuda import harness

pytestmark = pytest.mark.skipif(harness.unavailable() is not None, reason=str(harness.unavailable()))
harness.register()

pretends = pytest.mark.skipif(not pretend_device.AVAILABLE, reason="this PyTorch has no devices written in Python")


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_step_gives_what_the_reference_gives(name, ordered):
    expected, arguments = EXAMPLES[name](), EXAMPLES[name]()
    wanted, found = call(name, expected, "torch"), call(name, arguments, harness.BACKEND)
    for one, other in zip(state(found), state(wanted), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=3e-7)  # the last bit of a square root
    for key, value in arguments.items():
        assert equal(value, expected[key]), key
    assert ordered.started


def agree(*frames: Any, **options: Any) -> TSDFVolume:
    """Fuse frames by kernels and by plain torch; hold fields and surfaces to each other."""
    reference, found = (volume_of(*frames, backend=name, **options) for name in ("torch", harness.BACKEND))
    assert_same_volume(reference, found)
    same_surface(reference.blocks, found.blocks, reference.grid)
    assert_same(reference.extract_mesh(), found.extract_mesh(), tolerance=3e-7)
    return found


def same_surface(reference: tsdf.VoxelBlocks, found: tsdf.VoxelBlocks, grid: tsdf.VoxelGrid, least: int = 1) -> None:
    expected = tsdf.find_crossings(reference, grid, min_weight=least, edges=True, backend="torch")
    crossings = tsdf.find_crossings(found, grid, min_weight=least, edges=True, backend=harness.BACKEND)
    assert crossings.dropped == expected.dropped
    for field in fields(expected):
        one, other = getattr(crossings, field.name), getattr(expected, field.name)
        if field.name == "normals":
            torch.testing.assert_close(one, other, rtol=0, atol=3e-7)  # the last bit of a square root
        elif isinstance(one, Tensor):
            assert torch.equal(one, other), field.name
        else:
            assert one == other, field.name


def few_blocks() -> tsdf.VoxelBlocks:
    """Those of two views of a corner of the image."""
    made = tsdf.VoxelBlocks(tsdf.voxel_planes(colors=True, labels=True, views=True), torch.device("cpu"))
    for seed in range(2):
        corner = view(seed)
        corner.depth[6:], corner.depth[:, 6:] = 0, 0
        rows, missing = tsdf.locate_views(made, [corner], GRID, backend="torch")
        made.add(missing)
        tsdf.integrate_view(made, rows[0], corner, GRID, carve=True, backend="torch")
    return made


SIZES = [(1, 1), (3, 5), (8, 33), (24, 7), (33, 50)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_wild_views_of_any_size(size, kind):
    """From steps, slopes, noise and holes, seen from anywhere: near and far, blocks behind the camera and beside it."""
    for seed, reach in enumerate((0.02, 0.3, 1.0)):
        frames = [random_frame(size, reach, 2 * seed + more, lens=kind == "lens", images=True) for more in range(2)]
        volumes = [volume_of(voxel_size=0.03, backend=name, **KINDS[kind]) for name in ("torch", harness.BACKEND)]
        harness.use(seed)
        for frame in frames:
            for volume in volumes:
                volume.integrate(frame)
        assert_same_volume(*volumes)
    harness.use(0)


@pytest.mark.parametrize("kind", ["constant", "angle"])
def test_the_surface_of_wild_views(kind, ordered):
    frames = [random_frame((5, 6), 0.4, more, lens=False, images=True) for more in range(2)]
    assert agree(*frames, voxel_size=0.03, **KINDS[kind]).extract_points().num_points


def test_weights_asked_for_beyond_those_there_are(ordered):
    made = few_blocks()
    for least in (1, 65, 32768):
        same_surface(made, made, GRID, least)
        edge = tsdf.find_crossings(made, GRID, min_weight=least, edges=True, backend="torch").edge
        one, other = (
            tsdf.find_triangles(made, edge, min_weight=least, backend=name) for name in ("torch", harness.BACKEND)
        )
        assert all(torch.equal(*pair) for pair in zip(one, other, strict=True))


def test_triangles_lack_what_vertices_were_left_out(ordered):
    made = few_blocks()
    edge = tsdf.find_crossings(made, GRID, edges=True, backend="torch").edge
    for chosen in (edge[::2].clone(), edge[:0], edge[-1:], edge[torch.rand(len(edge), generator=seeded(0)) < 0.9]):
        one, other = (tsdf.find_triangles(made, chosen, backend=name) for name in ("torch", harness.BACKEND))
        assert all(torch.equal(*pair) for pair in zip(one, other, strict=True))


def test_voxels_at_random_wherever_their_blocks_lie(ordered):
    """Noise in every voxel: all 256 cases of the cube, all weights, neighbors at every side and none; at the border."""
    generator = seeded(4)
    made = tsdf.VoxelBlocks(tsdf.voxel_planes(colors=True, labels=True, views=True), torch.device("cpu"))
    most = 2**20 - 1
    places = torch.cartesian_prod(*[torch.arange(3)] * 3)[torch.randperm(27, generator=generator)[:19]]
    corner = torch.tensor([[most, most, most], [-most, -most, -most], [-most, most, 0], [0, -most, most]])
    made.add(pack_keys(torch.cat([places - 1, corner])).sort().values)
    for name, plane in made.chunks[0].items():
        low, high = {"tsdf": (-32767, 32768), "color": (0, 1 << 30)}.get(name, (0, 5))
        drawn = torch.randint(low, high, (len(made), 512), generator=generator)
        plane[: len(made)] = (drawn / 3 if name == "tsdf" else drawn).to(plane.dtype)
    for least in (1, 3):
        same_surface(made, made, GRID, least)
        edge = tsdf.find_crossings(made, GRID, min_weight=least, edges=True, backend="torch").edge
        one, other = (
            tsdf.find_triangles(made, edge, min_weight=least, backend=name) for name in ("torch", harness.BACKEND)
        )
        assert len(other[1])
        assert all(torch.equal(*pair) for pair in zip(one, other, strict=True))


def test_more_blocks_than_the_first_table_holds(ordered):
    """Every reading on its own: as many blocks as lookups, many times what a table is made for."""
    scattered = replace(view(0), depth=0.5 + 40 * torch.rand(48, 64, generator=seeded(1)))
    grid = tsdf.VoxelGrid(0.005, 0.02)
    expected = tsdf.touched_blocks(scattered, grid, backend="torch")
    assert len(expected) > 4096
    assert torch.equal(tsdf.touched_blocks(scattered, grid, backend=harness.BACKEND), expected)
    assert ordered.started.count("pc_touch_blocks") > 1
    made, growing = (tsdf.VoxelBlocks(tsdf.voxel_planes(), torch.device("cpu")) for _ in range(2))
    for name, where in (("torch", made), (harness.BACKEND, growing)):
        for step in range(3):
            moved = torch.eye(4, dtype=torch.float64)
            moved[1, 3] = 3.0 * step
            where.add(tsdf.locate_views(where, [replace(scattered, world_from_camera=moved)], grid, backend=name)[1])
    assert torch.equal(made.keys, growing.keys)
    assert torch.equal(tsdf.find_blocks(growing, expected, backend=harness.BACKEND)[0], made.find(expected))


@pytest.mark.parametrize("voxels", [2, 63.9, 64])
def test_the_narrowest_and_the_widest_truncation(voxels, ordered):
    some = replace(view(0), depth=view(0).depth * (torch.arange(64) % 16 == 0))
    grid = tsdf.VoxelGrid(0.01, voxels * 0.01)
    keys = tsdf.touched_blocks(some, grid, backend="torch")
    assert torch.equal(tsdf.touched_blocks(some, grid, backend=harness.BACKEND), keys)


def test_blocks_of_several_chunks(ordered):
    made, found = (tsdf.VoxelBlocks(tsdf.voxel_planes(), torch.device("cpu")) for _ in range(2))
    keys = tsdf.touched_blocks(view(0), GRID, backend="torch")
    others = pack_keys(torch.cartesian_prod(torch.arange(500, 600), torch.arange(90), torch.arange(1)))
    for one in (made, found):
        one.add(keys[::2])
        one.add(others)
        one.add(keys[1::2])
    assert len(made.chunks) > 1
    for name, one in (("torch", made), (harness.BACKEND, found)):
        rows, _ = tsdf.find_blocks(one, keys, backend=name)
        tsdf.integrate_view(one, rows, view(0), GRID, carve=True, backend=name)
    for a, b in zip(made.chunks, found.chunks, strict=True):
        assert all(torch.equal(plane, b[name]) for name, plane in a.items())


@pytest.mark.parametrize("reading", [0.0, -1.0, float("nan")])
def test_an_image_without_any_reading_touches_nothing(reading, ordered):
    nothing = replace(view(0), depth=torch.full((48, 64), reading))
    made, before = blocks(), blocks()
    rows, missing = tsdf.locate_views(made, [nothing], GRID, backend=harness.BACKEND)
    assert (len(rows[0]), len(missing)) == (0, 0)
    tsdf.integrate_view(made, torch.arange(len(made)), nothing, GRID, carve=True, backend=harness.BACKEND)
    tsdf.integrate_view(made, torch.arange(0), view(0), GRID, carve=True, backend=harness.BACKEND)
    assert equal(made, before)


def test_some_readings_that_are_none(ordered):
    some = view(0)
    some.depth[::3, ::5] = float("nan")
    some.depth[1::7] = -1.0
    keys = tsdf.touched_blocks(some, GRID, backend="torch")
    assert torch.equal(tsdf.touched_blocks(some, GRID, backend=harness.BACKEND), keys)


def test_nothing_was_seen_yet(ordered):
    made = tsdf.VoxelBlocks(tsdf.voxel_planes(colors=True, labels=True), torch.device("cpu"))
    found = tsdf.find_crossings(made, GRID, edges=True, backend=harness.BACKEND)
    expected = tsdf.find_crossings(made, GRID, edges=True, backend="torch")
    assert [one.shape for one in state(found)] == [one.shape for one in state(expected)]
    used, triangles = tsdf.find_triangles(made, found.edge, backend=harness.BACKEND)
    assert (used.shape, triangles.shape) == ((0,), (0, 3))
    rows, missing = tsdf.find_blocks(made, torch.tensor([5, 7]), backend=harness.BACKEND)
    assert (rows.tolist(), missing.tolist()) == ([-1, -1], [5, 7])


@pytest.mark.parametrize("reading", [1e6, 1e12, 1e30, float("inf")])
def test_a_reading_beyond_all_blocks_is_refused_as_by_the_reference(reading):
    far = view(0)
    far.depth[3, 5] = reading
    for ask in (
        lambda: tsdf.touched_blocks(far, GRID, backend=harness.BACKEND),
        lambda: tsdf.locate_views(blocks(), [view(1), far], GRID, backend=harness.BACKEND),
    ):
        with pytest.raises(UnitError, match=r"more than 2\^20"):
            ask()


def test_far_from_the_origin_and_at_the_border_of_the_grid(ordered):
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([1234.5, -6543.2, 15.0])
    depth = torch.linspace(0.1, 90.0, 24 * 32).reshape(24, 32) * (torch.arange(24 * 32).reshape(24, 32) % 70 == 0)
    agree(frame_of(depth, pose=pose), voxel_size=0.05)
    pose[:3, 3] = (2**20 - 3) * 8 * 0.02
    edge = replace(view(0), world_from_camera=pose)
    with pytest.raises(UnitError, match=r"more than 2\^20"):
        tsdf.touched_blocks(edge, GRID, backend=harness.BACKEND)
    pose[:3, 3] = (2**20 - 40) * 8 * 0.02
    keys = tsdf.touched_blocks(edge, GRID, backend="torch")
    assert torch.equal(tsdf.touched_blocks(edge, GRID, backend=harness.BACKEND), keys)


def test_a_field_is_handed_from_one_backend_to_the_other_and_back():
    frames = [random_frame((24, 32), 1.0, seed, lens=False, images=True) for seed in range(4)]
    volume = volume_of(voxel_size=0.03)
    for frame, backend in zip(frames, ("cpu", harness.BACKEND, "torch", harness.BACKEND)):
        volume.backend = backend if why_unavailable(backend) is None else "torch"
        volume.integrate(frame)
    assert_same_volume(volume, volume_of(*frames, voxel_size=0.03, backend="torch"))


def test_a_lens_that_kernels_do_not_know_is_left_to_plain_torch():
    tilted = torch.tensor([0.1, -0.05, 0.001, -0.002, 0.01, 0, 0, 0, 0, 0, 0, 0, 0.02, -0.01], dtype=torch.float64)
    seen = replace(view(0), distortion=tilted)
    made, found = blocks(), blocks()
    for name, one in (("torch", made), (harness.BACKEND, found)):
        tsdf.integrate_view(one, torch.arange(len(one)), seen, GRID, carve=True, backend=name)
    assert equal(made, found)


@pretends
@pytest.mark.parametrize("carve", ["near", "everywhere"])
def test_on_a_device_a_frame_waits_once_and_a_surface_once(carve, monkeypatch):
    device = harness.as_on_a_gpu(monkeypatch)
    frames = [random_frame((5, 7), 0.4, seed, lens=False, images=True) for seed in range(3)]
    here, there = (TSDFVolume(voxel_size=0.03, carve=carve, device=where) for where in ("cpu", device))
    here.backend = "torch"
    there.integrate(frames[0].to(device))  # sends the rays of the camera
    here.integrate(frames[0])
    for frame in frames[1:]:
        moved = frame.to(device)
        with pretend_device.watching() as watched:
            there.integrate(moved)
        assert watched.waits.total() == 1, watched.waits
        here.integrate(frame)
    assert torch.equal(pretend_device.host(there.blocks.keys), here.blocks.keys)
    with pretend_device.watching() as watched:
        found = there.extract_points()
    assert watched.waits.total() == 1, watched.waits
    assert_same(here.extract_points(), found.to("cpu"), tolerance=3e-7)
    with pretend_device.watching() as watched:
        mesh = there.extract_mesh()
    waits = {place: count for place, count in watched.waits.items() if "kernels" in place or "tsdf" in place}
    assert sum(waits.values()) == 3, waits  # for points, triangles, and the points in triangles
    assert_same(here.extract_mesh(), mesh.to("cpu"), tolerance=3e-7)


@pretends
def test_a_device_reserves_and_clears_as_the_host_does(monkeypatch):
    device = harness.as_on_a_gpu(monkeypatch)
    frames = [random_frame((5, 7), 0.4, seed, lens=False, images=True) for seed in range(3)]
    volume = TSDFVolume(voxel_size=0.03, device=device)
    volume.reserve(40 << 20)
    reserved = volume.reserved_bytes
    assert reserved >= 40 << 20
    volume.integrate(frames[0].to(device))
    volume.clear()
    for frame in frames[1:]:
        volume.integrate(frame.to(device))
    assert volume.reserved_bytes == max(reserved, volume.reserved_bytes)
    here = TSDFVolume(voxel_size=0.03, backend="torch")
    for frame in frames[1:]:
        here.integrate(frame)
    assert_same(here.extract_points(), volume.extract_points().to("cpu"), tolerance=3e-7)


@pretends
def test_views_of_one_capture_wait_once_together(monkeypatch):
    device = harness.as_on_a_gpu(monkeypatch)
    frame = tabletop_frame(3)
    volume = TSDFVolume(voxel_size=0.03, device=device)
    volume.integrate(frame.to(device))  # sends the rays of the cameras
    moved = frame.to(device)
    with pretend_device.watching() as watched:
        volume.integrate(moved)
    assert watched.waits.total() == 1, watched.waits
    expected = volume_of(frame, frame, voxel_size=0.03, backend="torch").blocks
    for name, plane in expected.chunks[0].items():
        assert torch.equal(plane, pretend_device.host(volume.blocks.chunks[0][name])), name


@pretends
@pytest.mark.parametrize("backend", ["auto", "torch"])
@pytest.mark.parametrize("label", [2**31, -(2**31) - 1, 2**32])
def test_labels_beyond_32_bits_are_refused_there_and_leave_the_field_as_it_was(label, backend, monkeypatch):
    device = harness.as_on_a_gpu(monkeypatch)
    frame = random_frame((5, 7), 0.4, 0, lens=False, images=True)
    volume = TSDFVolume(voxel_size=0.03, device=device, backend=backend)
    volume.integrate(frame.to(device))
    before = {name: pretend_device.host(plane).clone() for name, plane in volume.blocks.chunks[0].items()}
    labels = frame.labels.clone()
    labels[0, 2, 3] = label
    for door in (volume.integrate, volume.estimate_bytes):
        with pytest.raises(CaptureError, match="labels must fit 32 bits"):
            door(replace(frame, labels=labels).to(device))
    assert all(torch.equal(pretend_device.host(volume.blocks.chunks[0][name]), plane) for name, plane in before.items())
    labels[0, 2, 3] = 2**31 - 1
    volume.integrate(replace(frame, labels=labels).to(device))
