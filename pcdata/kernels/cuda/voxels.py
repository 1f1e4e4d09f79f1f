"""Voxels by a hash table; their sums are whole numbers, so their means are the reference's bits."""

from __future__ import annotations

import torch
from torch import Tensor

import pcdata.functional.voxels  # noqa: F401 - the function must be registered before its kernel
from pcdata.contracts.dispatch import INNER, kernel
from pcdata.kernels.cuda.cells import MOST_ROWS, num_places
from pcdata.kernels.cuda.launching import Launcher, launcher_of

_ROWS_OF_A_WARP = 1024


@kernel("voxel_means", "cuda")
def voxel_means(
    points: Tensor, ptr: Tensor, edges: Tensor, origin: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Number, sum, average; the one wait is for the number of voxels."""
    rows, clouds, device = len(points), len(ptr) - 1, points.device
    if 0 < rows <= MOST_ROWS:
        launcher = launcher_of(points)
        points, ptr, sizes = points.detach().contiguous(), ptr.contiguous(), edges.expand(-1, 3).contiguous()
        origins = _lowest_corners(launcher, points, ptr) - edges / 2 if origin is None else origin
        searched = points, ptr, clouds, rows, origins.contiguous(), sizes
        size = num_places(rows)
        places = torch.zeros(size, dtype=torch.int64, device=device)
        lowest = torch.full((size,), torch.iinfo(torch.int32).max, dtype=torch.int32, device=device)
        far = torch.zeros(1, dtype=torch.int32, device=device)
        place_of, is_first = torch.empty((2, rows), dtype=torch.int32, device=device).unbind()
        launcher.launch("pc_insert_voxels", rows, *searched, places, size - 1, place_of, lowest, far)
        launcher.launch("pc_mark_first_of_voxels", rows, rows, place_of, lowest, is_first)
        begun = is_first.cumsum(0)
        sums = torch.zeros((rows, 3), dtype=torch.int64, device=device)
        members = torch.zeros(rows, dtype=torch.int64, device=device)
        inverse = torch.empty(rows, dtype=torch.int64, device=device)
        launcher.launch("pc_sum_voxels", rows, *searched, place_of, lowest, begun, inverse, sums, members)
        means = torch.empty((rows, 3), dtype=torch.float32, device=device)
        launcher.launch("pc_average_voxels", rows, *searched, is_first, begun, sums, members, means)
        number, is_far = torch.cat([begun[-1:], far]).tolist()
        if not is_far:
            means_ptr = torch.cat([begun.new_zeros(1), begun])[ptr]
            return means[:number].clone(), means_ptr, inverse, members[:number].clone()
    fallen: tuple[Tensor, Tensor, Tensor, Tensor] = INNER["voxel_means"].reference(points, ptr, edges, origin)
    return fallen  # which knows what to say of points far out


def _lowest_corners(launcher: Launcher, points: Tensor, ptr: Tensor) -> Tensor:
    """Return (B, 3) float64: the least coordinates of each cloud; of an empty one any."""
    rows, clouds = len(points), len(ptr) - 1
    most = torch.iinfo(torch.int32).max
    corners = torch.full((clouds, 3), most, dtype=torch.int32, device=points.device)
    threads = 32 * -(-rows // _ROWS_OF_A_WARP)
    launcher.launch("pc_find_corners", threads, points, ptr, clouds, rows, _ROWS_OF_A_WARP, corners)
    return torch.where(corners < 0, corners ^ most, corners).view(torch.float32).double()
