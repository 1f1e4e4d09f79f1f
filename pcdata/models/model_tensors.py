"""From clouds to the tensors of a contract: COLUMNS compute channels, PACKERS lay them out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import torch
from torch import Tensor

from pcdata.errors import ConfigError, DTypeError, ShapeError
from pcdata.functional.rows import cloud_of_rows, pad_rows, segment_min, transform_points
from pcdata.functional.voxel_averages import voxel_mean
from pcdata.functional.voxels import voxel_cells
from pcdata.models.contract import InputTensor, ModelContract
from pcdata.structures import PointCloud

# torchvision's: the colors that ImageNet backbones were trained with.
_IMAGENET_MEAN = (0.485, 0.456, 0.406)
_IMAGENET_STD = (0.229, 0.224, 0.225)

GRID_CELLS = 100  # per axis, PerAct
_CELL = 0.005  # metres: GSNet's and RISE's voxels


def contract_tensor(clouds: PointCloud, contract: ModelContract, tensor: InputTensor) -> Tensor:
    """Make one tensor of a contract from packed clouds.

    Raises:
        ConfigError, DTypeError, FrameError, ShapeError: the clouds lack what the model takes.
    """
    return PACKERS[tensor.content](clouds, contract, tensor)


def columns(clouds: PointCloud, contract: ModelContract, tensor: InputTensor) -> Tensor:
    """(N, C): the channels of all points in the contract's order; one channel alone is not copied."""
    parts = [COLUMNS[channel.name](clouds, contract) for channel in tensor.channels]
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)


def _columns_in_layout(clouds: PointCloud, contract: ModelContract, tensor: InputTensor) -> Tensor:
    rows = columns(clouds, contract, tensor)
    if tensor.layout == "S C":
        return rows
    counts = clouds.counts.tolist()
    if min(counts) == max(counts):  # packed rows are the batch already
        padded = rows.reshape(len(counts), counts[0], tensor.width)
    else:
        padded = pad_rows({"rows": rows.split(counts)}, max(counts), {"rows": 0})["rows"]
    return padded.transpose(1, 2).contiguous() if tensor.layout == "B C N" else padded


def _category(clouds: PointCloud, contract: ModelContract, tensor: InputTensor) -> Tensor:
    """One-hot (B, C) or (B, 1, C) of meta's ``category``."""
    numbers = [entry.get("category") for entry in clouds.meta]
    if any(not isinstance(number, int) for number in numbers):
        raise ConfigError(f"{contract.name}: no category; make the preset with category=0 ... {tensor.width - 1}")
    one_hot = torch.nn.functional.one_hot(
        torch.tensor(numbers, dtype=torch.int64, device=clouds.device), tensor.width
    ).float()
    return one_hot[:, None] if tensor.layout == "B 1 C" else one_hot


def _cells_of_batch(clouds: PointCloud, contract: ModelContract, tensor: InputTensor) -> Tensor:
    """(S, 4) int32: the cloud's number and its cell, cut toward zero as RISE's cast does, from float64 as there."""
    cells = (clouds.points.double() / _CELL).to(torch.int32)
    return torch.cat([cloud_of_rows(clouds.ptr)[:, None].to(torch.int32), cells], dim=1)


def _grid_cells(clouds: PointCloud, contract: ModelContract, tensor: InputTensor) -> Tensor:
    """(S, 3) int64: cells counted from the lowest of each cloud."""
    assert contract.voxel is not None
    cells = voxel_cells(clouds.points, contract.voxel)
    parts = torch.tensor_split(cells, clouds.ptr[1:-1].cpu())
    return torch.cat([part - part.amin(dim=0) if len(part) else part for part in parts])


def _offset(clouds: PointCloud, contract: ModelContract, tensor: InputTensor) -> Tensor:
    return clouds.ptr[1:].clone()


def _voxel_grid(clouds: PointCloud, contract: ModelContract, tensor: InputTensor) -> Tensor:
    """(B, C, X, Y, Z): per cell the mean of the points' channels, the cell's index / 100, and 1 where occupied.

    Points outside the box are left out; cells are counted as PerAct counts them, from a border of one cell around it.
    """
    assert contract.crop is not None
    lower, upper = clouds.points.new_tensor(contract.crop)
    edge = (upper - lower) / GRID_CELLS
    cell = torch.floor((clouds.points - (lower - edge)) / edge).long() - 1
    inside = ((cell >= 0) & (cell < GRID_CELLS)).all(dim=1)
    cell, owner = cell[inside], cloud_of_rows(clouds.ptr)[inside]
    flat = ((owner * GRID_CELLS + cell[:, 0]) * GRID_CELLS + cell[:, 1]) * GRID_CELLS + cell[:, 2]
    occupied, inverse = torch.unique(flat, return_inverse=True)
    values = torch.cat([clouds.points, COLUMNS["rgb_signed"](clouds, contract)], dim=1)[inside]
    # Filled where it stays: one grid is 40 MB, and cells are few.
    grid = values.new_zeros((clouds.num_clouds, tensor.width, GRID_CELLS**3))
    batch, place = occupied // GRID_CELLS**3, occupied % GRID_CELLS**3
    grid[batch, : values.shape[1], place] = voxel_mean(values, inverse, len(occupied))
    grid[batch, -1, place] = 1.0
    grid = grid.reshape(clouds.num_clouds, tensor.width, GRID_CELLS, GRID_CELLS, GRID_CELLS)
    steps = torch.arange(GRID_CELLS, dtype=torch.float32, device=clouds.device) / GRID_CELLS
    grid[:, 6], grid[:, 7], grid[:, 8] = steps[:, None, None], steps[:, None], steps
    return grid


def _organized(clouds: PointCloud, contract: ModelContract, tensor: InputTensor) -> Tensor:
    """(B, V, C, H, W): every point back at its pixel, 0 where there was no reading."""
    if clouds.layout is None or clouds.source_index is None:
        raise ShapeError(
            f"{contract.name}: takes organized clouds, one point per pixel; these have no pixels: give depth images, "
            "not cloud files, and remove the steps that sample, merge or average points"
        )
    height, width = clouds.layout.size
    views = list(Counter(entry.get("sample", number) for number, entry in enumerate(clouds.meta)).values())
    if min(views) != max(views):
        raise ShapeError(f"{contract.name}: every capture of a batch must have as many views, got {views}")
    images = clouds.points.new_zeros((clouds.num_clouds * height * width, tensor.width))
    pixel = clouds.source_index % (height * width) + cloud_of_rows(clouds.ptr) * height * width
    images[pixel] = columns(clouds, contract, tensor)
    images = images.reshape(len(views), views[0], height, width, tensor.width)
    return images.permute(0, 1, 4, 2, 3).contiguous()


def _xyz_in_frame(clouds: PointCloud, contract: ModelContract) -> Tensor:
    """The points before centering, in the contract's frame."""
    return transform_points(clouds.points, clouds.ptr, clouds.frame_from_cloud(contract.frame))


def _colors(clouds: PointCloud, contract: ModelContract) -> Tensor:
    if clouds.colors is None:
        raise DTypeError(
            f"{contract.name}: takes colors and the cloud has none; give captures with color, or leave the channel "
            "out where it is optional (channels=...)"
        )
    return clouds.colors


def _normals(clouds: PointCloud, contract: ModelContract) -> Tensor:
    if clouds.normals is None:
        raise DTypeError(f"{contract.name}: takes normals and the cloud has none; add EstimateNormals")
    return clouds.normals


def _imagenet(clouds: PointCloud, contract: ModelContract) -> Tensor:
    colors = _colors(clouds, contract)
    return (colors - colors.new_tensor(_IMAGENET_MEAN)) / colors.new_tensor(_IMAGENET_STD)


def _xyz_column(clouds: PointCloud, contract: ModelContract) -> Tensor:
    """The points with x and y from the column's center; z stays."""
    shift = _meta_rows(clouds, contract, "column_center")
    return clouds.points - shift * shift.new_tensor([1.0, 1.0, 0.0])


def _xyz_block(clouds: PointCloud, contract: ModelContract) -> Tensor:
    """The points with x and y from the smallest of the cloud plus half a column; z stays."""
    assert contract.column is not None
    lowest = segment_min(clouds.points, clouds.ptr)
    shift = (lowest + contract.column / 2) * lowest.new_tensor([1.0, 1.0, 0.0])
    return clouds.points - shift[cloud_of_rows(clouds.ptr)]


def _xyz_room(clouds: PointCloud, contract: ModelContract) -> Tensor:
    """The coordinates as parts of the room's extent."""
    return clouds.points / _meta_rows(clouds, contract, "extent").clamp(min=1e-9)


def _meta_rows(clouds: PointCloud, contract: ModelContract, name: str) -> Tensor:
    if any(name not in entry for entry in clouds.meta):
        raise ConfigError(f"{contract.name}: the clouds have no {name}; run them through the preset's pipeline")
    values = clouds.points.new_tensor([entry[name] for entry in clouds.meta])
    return values[cloud_of_rows(clouds.ptr)]


COLUMNS: dict[str, Callable[[PointCloud, ModelContract], Tensor]] = {
    "xyz": lambda clouds, _: clouds.points,
    "xyz_in_frame": _xyz_in_frame,
    "xyz_block": _xyz_block,
    "xyz_column": _xyz_column,
    "xyz_room": _xyz_room,
    "xyz_cells": lambda clouds, _: clouds.points / _CELL,
    "ones": lambda clouds, _: torch.ones_like(clouds.points),
    "rgb": _colors,
    "rgb_255": lambda clouds, contract: _colors(clouds, contract) * 255.0,
    "rgb_signed": lambda clouds, contract: _colors(clouds, contract) * 2.0 - 1.0,
    "rgb_imagenet": _imagenet,
    "normals": _normals,
}

PACKERS: dict[str, Callable[[PointCloud, ModelContract, InputTensor], Tensor]] = {
    "columns": _columns_in_layout,
    "category": _category,
    "cells_of_batch": _cells_of_batch,
    "grid_cells": _grid_cells,
    "offset": _offset,
    "voxel_grid": _voxel_grid,
    "organized": _organized,
}
