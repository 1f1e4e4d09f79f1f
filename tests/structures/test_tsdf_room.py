"""TSDFVolume.reserve and clear: the memory is there beforehand, stays, and changes no bit of what is stored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pcdata.errors import ConfigError, VolumeTooLargeError
from pcdata.functional.tsdf import VoxelRoom
from pcdata.io import read_volume, write_volume
from pcdata.structures import TSDFVolume
from tests.factories import tabletop_frame
from tests.functional.tsdf.test_volume import assert_same_volume

MIB = 1 << 20
FRAMES = [tabletop_frame(1, seed=seed) for seed in (0, 3)]


def volume_of(*frames, **options) -> TSDFVolume:
    volume = TSDFVolume(**{"voxel_size": 0.01, **options})
    for frame in frames:
        volume.integrate(frame)
    return volume


def resident() -> int:
    """The bytes of this process that lie in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="what is in memory is read from /proc")
def test_reserved_memory_is_there_before_any_frame_and_suffices():
    volume = volume_of(*FRAMES)  # what every process needs once
    needed = volume.num_bytes
    room = TSDFVolume(voxel_size=0.002, max_bytes=300 * MIB)
    before = resident()
    room.reserve(256 * MIB)
    reserved = resident()
    assert abs(reserved - before - 256 * MIB) < 8 * MIB
    for frame in FRAMES:
        room.integrate(frame)
    assert needed < room.num_bytes < room.reserved_bytes == 256 * MIB
    assert resident() - reserved < 16 * MIB  # of keys, tables and rays


@pytest.mark.parametrize("amounts", [(1,), (3 * MIB, 20 * MIB, 1), (200 * MIB, 300 * MIB)])
@pytest.mark.parametrize("when", ["before", "between"])
def test_reserving_changes_no_bit(amounts, when):
    volume = TSDFVolume(voxel_size=0.004)
    for step, frame in enumerate(FRAMES):
        for amount in amounts if step == (when == "between") else ():
            volume.reserve(amount)
            assert volume.reserved_bytes >= amount
        volume.integrate(frame)
    assert_same_volume(volume, volume_of(*FRAMES, voxel_size=0.004))


def test_what_is_stored_is_not_moved():
    volume = volume_of(FRAMES[0])
    start = volume.blocks.chunks[0]["tsdf"].data_ptr()
    volume.reserve(np.int64(200 * MIB))
    volume.integrate(FRAMES[1])
    assert volume.blocks.chunks[0]["tsdf"].data_ptr() == start


@pytest.mark.parametrize("amounts", [(5000, 1), (5000, 12000), (1, 9999), (10000, 10000)])
def test_pieces_of_a_room_never_overlap_and_are_zero(amounts):
    room = VoxelRoom(torch.device("cpu"))
    taken = []
    for amount in amounts:
        room.reserve(amount)
        for _ in range(3):
            taken.append(room.take(4096))
            assert int(taken[-1].sum()) == 0
            taken[-1].fill_(len(taken))
    assert [int(one.min()) for one in taken] == [int(one.max()) for one in taken] == list(range(1, len(taken) + 1))
    room.reserve(1 << 20)  # touches what is taken too
    assert [int(one.sum()) for one in taken] == [4096 * number for number in range(1, len(taken) + 1)]


@pytest.mark.parametrize("wrong", [0, -1, 1.5, True, None, float("inf"), "1GB"])
def test_amounts_that_are_none_are_refused(wrong):
    with pytest.raises(ConfigError, match="num_bytes must be a whole number from 1 on"):
        TSDFVolume().reserve(wrong)


def test_more_than_is_allowed_or_there_is_refused_and_changes_nothing():
    volume = volume_of(FRAMES[0])
    reserved, before = volume.reserved_bytes, volume.extract_points()
    with pytest.raises(VolumeTooLargeError, match="more than max_bytes allows"):
        volume.reserve(volume.max_bytes + 1)
    for amount in (1 << 50, 1 << 62, 1 << 90):
        volume.max_bytes = amount
        with pytest.raises(VolumeTooLargeError, match=r"cpu has no .* MiB for voxels"):
            volume.reserve(amount)
    assert volume.reserved_bytes == reserved
    fresh = TSDFVolume(max_bytes=1 << 50)
    fresh.reserve(3 * MIB)
    with pytest.raises(VolumeTooLargeError):
        fresh.reserve(1 << 50)
    assert fresh.reserved_bytes == 3 * MIB
    assert volume.extract_points().points.equal(before.points)


def test_a_frame_for_which_there_is_no_memory_leaves_the_volume_as_it_was(monkeypatch):
    volume = volume_of(FRAMES[0])
    blocks, before = volume.num_blocks, volume.extract_points()

    def none_left(self: VoxelRoom, count: int) -> torch.Tensor:
        raise VolumeTooLargeError("none left")

    monkeypatch.setattr(VoxelRoom, "take", none_left)
    finer = TSDFVolume(voxel_size=0.01)
    with pytest.raises(VolumeTooLargeError, match="none left"):
        finer.integrate(FRAMES[0])
    assert (finer.num_blocks, finer.num_views, finer.frame_id) == (0, 0, None)
    volume.blocks.chunks.clear()  # as if they were full
    with pytest.raises(VolumeTooLargeError, match="none left"):
        volume.integrate(tabletop_frame(1, seed=5))
    assert (volume.num_blocks, volume.num_views) == (blocks, 1)
    assert before.num_points > 0


@pytest.mark.parametrize("backend", ["auto", "torch"])
def test_a_cleared_volume_is_as_new_in_the_same_memory(backend, tmp_path):
    volume = volume_of(*FRAMES, backend=backend)
    volume.extract_points()
    start, reserved = volume.blocks.chunks[0]["tsdf"].data_ptr(), volume.reserved_bytes
    volume.clear()
    assert (volume.num_views, volume.num_blocks, volume.num_bytes) == (0, 0, 0)
    with pytest.raises(ConfigError, match="nothing was integrated yet"):
        volume.extract_mesh()
    with pytest.raises(ConfigError, match="nothing was integrated yet"):
        write_volume(tmp_path / "volume.npz", volume)
    volume.integrate(FRAMES[1])
    assert (volume.blocks.chunks[0]["tsdf"].data_ptr(), volume.reserved_bytes) == (start, reserved)
    assert_same_volume(volume, volume_of(FRAMES[1], backend=backend))
    TSDFVolume().clear()


def test_a_volume_with_chunks_to_spare_is_written_and_read(tmp_path):
    volume = volume_of(*FRAMES, voxel_size=0.001)
    spare = len(volume.blocks.chunks)
    volume.clear()
    volume.integrate(FRAMES[0])
    volume.blocks.chunks.append(volume.blocks.chunks[0])
    write_volume(tmp_path / "volume.npz", volume)
    found = read_volume(tmp_path / "volume.npz")
    assert len(found.blocks.chunks) < len(volume.blocks.chunks) > spare - 1
    del volume.blocks.chunks[len(found.blocks.chunks) :]
    assert_same_volume(found, volume)
    more = found.reserved_bytes + 1
    found.reserve(more)
    assert found.reserved_bytes == more
