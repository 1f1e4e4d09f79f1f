"""The peers of fusion: Open3D's tensor VoxelBlockGrid, and its legacy ScalableTSDFVolume in a process of its own.

The tensor grid reads the pixel that a projection is rounded down to, so it takes integer coordinates for pixel corners:
half a pixel is added to the principal point, which makes it read the nearest one, as pcdata does. (Given the intrinsics
as they are, its surfaces lie half a pixel to the side.)

The legacy volume integrates nothing in release 0.20; release 0.19 does, in an interpreter that has it.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import open3d as o3d
import torch
from torch import Tensor

from pcdata.structures import DepthFrame

BLOCK = 16  # voxels along an edge, the value of Open3D's examples
_FAR = 10.0  # metres, beyond every reading
_SEEN = 0.5  # views: keep whatever was seen once


class Open3DView(NamedTuple):
    """One view in the types that Open3D's kernels read."""

    depth: Any
    color: Any
    intrinsics: Any  # of pixel corners
    camera_from_world: Any

    @staticmethod
    def of(frame: DepthFrame) -> Open3DView:
        """Convert the one view of a frame."""
        assert frame.world_from_camera is not None
        assert frame.colors is not None
        corners = frame.camera.intrinsics[0].numpy().copy()
        corners[:2, 2] += 0.5
        return Open3DView(
            depth=o3d.t.geometry.Image(o3d.core.Tensor(frame.depth[0].numpy())),
            color=o3d.t.geometry.Image(o3d.core.Tensor(frame.colors[0].numpy().astype(np.float32) / 255)),
            intrinsics=o3d.core.Tensor(corners),
            camera_from_world=o3d.core.Tensor(np.linalg.inv(frame.world_from_camera[0].numpy())),
        )


class Open3DGrid:
    """A tensor grid with distance, weight and color; ``multiple`` is its truncation in voxels.

    It takes room for ``num_blocks`` at once, and doubles that when it is used up.
    """

    def __init__(self, voxel_size: float, multiple: float, num_blocks: int = 10_000) -> None:
        self.voxel_size = voxel_size
        self.multiple = float(multiple)  # its bindings take no integer there
        self.grid = o3d.t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight", "color"),
            attr_dtypes=(o3d.core.float32, o3d.core.float32, o3d.core.float32),
            attr_channels=((1), (1), (3)),
            voxel_size=voxel_size,
            block_resolution=BLOCK,
            block_count=num_blocks,
            device=o3d.core.Device("CPU:0"),
        )

    def touched(self, view: Open3DView) -> Any:
        """Return the blocks (N, 3) that a view opens: along the rays of every fourth pixel, at four depths."""
        return self.grid.compute_unique_block_coordinates(
            view.depth, view.intrinsics, view.camera_from_world, 1.0, _FAR, self.multiple
        )

    def integrate(self, view: Open3DView) -> None:
        """Average a view into the blocks that it touches."""
        k = view.intrinsics
        self.grid.integrate(
            self.touched(view), view.depth, view.color, k, k, view.camera_from_world, 1.0, _FAR, self.multiple
        )

    def extract(self) -> Any:
        """Return the cloud of all that was seen at least once."""
        return self.grid.extract_point_cloud(weight_threshold=_SEEN)

    @property
    def num_bytes(self) -> int:
        """What the voxels of the blocks in use take."""
        return int(self.grid.hashmap().size()) * BLOCK**3 * 4 * 5

    def voxels(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distance (in truncations) and the weight of voxels (N, 3) int64 of the whole grid; 0 if absent."""
        block = torch.div(places, BLOCK, rounding_mode="floor")
        x, y, z = (places - BLOCK * block).unbind(-1)
        row, found = self.grid.hashmap().find(o3d.core.Tensor(block.numpy().astype(np.int32)))
        known = torch.from_numpy(found.numpy().copy())
        at = torch.where(known, torch.from_numpy(row.numpy().astype(np.int64)), 0) * BLOCK**3
        at += (z * BLOCK + y) * BLOCK + x
        tsdf, weight = (torch.from_numpy(self.grid.attribute(name).numpy().ravel()[at.numpy()]) for name in _PLANES)
        return torch.where(known, tsdf, 0), torch.where(known, weight, 0)


_PLANES = ("tsdf", "weight")


def room_for(views: Iterable[Open3DView], voxel_size: float, multiple: float) -> int:
    """How many blocks a grid of these views must have room for so that it never grows, which copies them all.

    The blocks that it will hold, and once more those of the view that touches most: before it opens the blocks of a
    view it makes room for all of them, the known ones too.
    """
    grid = Open3DGrid(voxel_size, multiple, num_blocks=1)
    found: set[tuple[int, ...]] = set()
    most = 0
    for view in views:
        blocks = grid.touched(view).numpy().tolist()
        found.update(map(tuple, blocks))
        most = max(most, len(blocks))
    return len(found) + most


def positions(cloud: Any) -> Tensor:
    """(N, 3) float32: the points of an Open3D tensor cloud, copied."""
    return torch.from_numpy(cloud.point.positions.numpy().copy())


def open3d_surface(frames: Sequence[DepthFrame], voxel_size: float) -> Tensor:
    """(N, 3) float32: the points of a truncation of 5 voxels, of all that was seen at least once."""
    grid = Open3DGrid(voxel_size, 5)
    for frame in frames:
        grid.integrate(Open3DView.of(frame))
    return positions(grid.extract())


class LegacyVolume:
    """A ScalableTSDFVolume in another interpreter, told over a pipe what to do; it reads its own clocks."""

    def __init__(self, python: str, frames: Path, voxel_size: float, multiple: float) -> None:
        script = str(Path(__file__).with_name("fusion_legacy.py"))
        command = [python, script, str(frames), str(voxel_size), str(multiple * voxel_size)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.version = self._answer()["version"]

    def integrate(self, number: int) -> tuple[float, float]:
        """Integrate one of the frames; return seconds of the processor and of the clock."""
        answer = self._ask(str(number))
        return answer["cpu"], answer["wall"]

    def extract(self) -> dict[str, float]:
        """Extract the cloud; return the two times, the points, and the growth in bytes before and after."""
        return self._ask("extract")

    def close(self) -> None:
        """End the process."""
        self._process.communicate()

    def _ask(self, words: str) -> dict[str, float]:
        assert self._process.stdin is not None
        self._process.stdin.write(words + "\n")
        self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self._process.args[0]} ended early; does it have Open3D 0.19?")  # type: ignore[index]
        return dict(json.loads(line))


def write_frames(path: Path, frames: Sequence[DepthFrame]) -> None:
    """Keep the views of frames as arrays for another interpreter."""
    np.savez(
        path,
        depth=torch.cat([frame.depth for frame in frames]).numpy(),
        color=torch.cat([frame.colors for frame in frames if frame.colors is not None]).numpy(),
        intrinsics=torch.cat([frame.camera.intrinsics for frame in frames]).numpy(),
        pose=torch.cat([f.world_from_camera for f in frames if f.world_from_camera is not None]).numpy(),
    )
