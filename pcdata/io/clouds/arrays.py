"""What a cloud file carries, as plain arrays: the step between a file format's columns and a :class:`PointCloud`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pcdata.contracts.lengths import check_metres
from pcdata.contracts.tensors import check_tensors
from pcdata.errors import CaptureError, DTypeError, ShapeError
from pcdata.io.clouds.statement import CloudStatement
from pcdata.structures import METRE, Kind, PointCloud
from pcdata.structures.image_layout import seen_through_pinhole
from pcdata.structures.kinds import FIELDS, KINDS
from pcdata.structures.point_arrays import held_tensor, metres, unit_colors, unit_normals, whole_labels


@dataclass(kw_only=True)
class CloudArrays:
    """The columns of one cloud, N rows each, before rows without a reading are dropped."""

    xyz: NDArray[np.floating[Any]]  # (N, 3)
    normals: NDArray[np.floating[Any]] | None = None  # (N, 3)
    rgb: NDArray[Any] | None = None  # (N, 3): see unit_colors
    labels: NDArray[Any] | None = None  # (N,) whole numbers
    extra: Mapping[str, NDArray[Any]] = field(default_factory=dict)  # name -> (N, ...)
    kinds: Mapping[str, Kind] = field(default_factory=dict)  # of extra fields, where known


@np.errstate(invalid="ignore", over="ignore")  # NaNs of every kind are judged by value
def to_cloud(
    where: str,
    arrays: CloudArrays,
    *,
    statement: CloudStatement,
    frame_id: str | None,
    metres_per_unit: float | None,
    viewpoint: Sequence[float] | None = None,
    meta: Mapping[str, Any] | None = None,
) -> PointCloud:
    """Make the cloud of all rows whose x, y and z are finite; ``source_index`` keeps their row in the file.

    Frame and unit are those that the file or the caller states; numbers whose unit nobody states are metres, provided
    that they look like it. Rows that are the pixels of a pinhole camera get the layout of its image. Normals get unit
    length, as only their direction means anything; a NaN normal becomes the zero vector. Extra names that are no Python
    names, or are taken, are changed with underscores.
    """
    frame = statement.frame(where, frame_id)
    stated = statement.metres_per_unit(where, metres_per_unit)
    keep = np.isfinite(arrays.xyz).all(axis=1)
    if len(keep) and not keep.any():
        raise CaptureError(f"{where}: none of the {len(keep)} points has finite coordinates; drop this file")
    rows = slice(None) if keep.all() else keep
    xyz = arrays.xyz[rows]
    unit = check_metres(where, xyz, stated, viewpoint=viewpoint or (0.0, 0.0, 0.0))
    points = metres(where, xyz, unit)
    extra: dict[str, torch.Tensor] = {}
    kinds: dict[str, Kind] = {}
    for given, values in arrays.extra.items():
        name = free_name(given, extra)
        extra[name] = held_tensor(f"{where}: field {given!r}", values[rows])
        kinds[name] = arrays.kinds.get(given) or kind_of_column(name, extra[name])
        if KINDS[kinds[name]].is_length:
            extra[name] = extra[name] * unit
    source = statement.source_from_cloud
    source_index = torch.from_numpy(np.flatnonzero(keep))
    organized = (meta or {}).get("organized_size")
    layout = None
    if organized is not None and source is None:  # coordinates that were moved lie on no image
        layout = seen_through_pinhole(torch.from_numpy(points), source_index, tuple(organized))
    return PointCloud(
        points=torch.from_numpy(points),
        frame_id=frame,
        colors=None if arrays.rgb is None else torch.from_numpy(unit_colors(where, arrays.rgb[rows])),
        normals=None if arrays.normals is None else torch.from_numpy(unit_normals(arrays.normals[rows])),
        labels=None if arrays.labels is None else torch.from_numpy(whole_labels(where, arrays.labels[rows])),
        source_index=source_index,
        extra=extra,
        kinds=kinds,
        viewpoint=None if viewpoint is None else torch.tensor([viewpoint], dtype=torch.float32, device="cpu") * unit,
        source_from_cloud=None if source is None else source[None],  # type: ignore[arg-type]
        source_frame=statement.source_frame or "",
        frames={name: matrix[None] for name, matrix in statement.frames.items()},
        unit=statement.unit or METRE,
        layout=layout,
        meta=(dict(meta or {}),),
    )


def from_cloud(where: str, cloud: PointCloud) -> CloudArrays:
    """Return the arrays of a single cloud, colors as uint8; ``source_index`` is left behind.

    Raises:
        ShapeError: the cloud is a batch.
        DTypeError, NonFiniteError, CaptureError: a field cannot be stored.
    """
    if cloud.num_clouds != 1:
        raise ShapeError(f"{where}: a file holds one cloud, got a batch of {cloud.num_clouds}; write each of unbatch()")
    foreign = [name for name in cloud.extra if not name.isascii()]
    if foreign:
        raise CaptureError(f"{where}: field names must be ASCII in a file, got {', '.join(foreign)}; rename them")
    core = {"points": cloud.points, "colors": cloud.colors, "normals": cloud.normals}
    check_tensors(where, core, dict.fromkeys(core, "N 3"))
    rgb = None
    if cloud.colors is not None:
        colors = cloud.colors.detach().cpu().numpy()
        if len(colors) and not (colors.min() >= 0 and colors.max() <= 1):
            raise CaptureError(f"{where}: colors must lie in 0..1, got {colors.min():g} .. {colors.max():g}")
        rgb = np.rint(colors * 255.0).astype(np.uint8)
    return CloudArrays(
        xyz=cloud.points.detach().cpu().numpy(),
        normals=None if cloud.normals is None else cloud.normals.detach().cpu().numpy(),
        rgb=rgb,
        labels=None if cloud.labels is None else cloud.labels.cpu().numpy(),
        extra={name: _array(f"{where}: {name}", value) for name, value in cloud.extra.items()},
    )


def narrowest_int(where: str, values: NDArray[np.int64], choices: Sequence[str]) -> NDArray[Any]:
    """Return int64 values in the first of the dtypes that holds all of them."""
    for dtype in choices:
        limits = np.iinfo(dtype)
        if not len(values) or (limits.min <= values.min() and values.max() <= limits.max):
            return values.astype(dtype)
    raise DTypeError(f"{where}: values {values.min()} .. {values.max()} do not fit any integer type of this format")


def _array(where: str, value: torch.Tensor) -> NDArray[Any]:
    odd_type = value.dtype in (torch.bfloat16, torch.float16) or value.is_complex()
    if odd_type or value.ndim > 2 or 0 in value.shape[1:]:
        raise DTypeError(
            f"{where}: a file holds (N,) or (N, C) integers or floats of 32 or 64 bits, "
            f"got {value.dtype} {tuple(value.shape)}"
        )
    array: NDArray[Any] = value.detach().cpu().numpy()
    return array.astype(np.uint8) if array.dtype == bool else array


def kind_of_column(name: str, value: torch.Tensor) -> Kind:
    """Return the kind of a field of which only the name is known."""
    # Scanners write a "confidence" of their own as floats; pcdata's levels are bytes.
    return Kind.MINIMUM if name == "confidence" and value.dtype == torch.uint8 else Kind.INVARIANT


def free_name(name: str, taken: Mapping[str, Any]) -> str:
    """Return a name that an extra field can bear: underscores for what no Python name has, or where it is taken."""
    name = "".join(letter if ("_" + letter).isidentifier() else "_" for letter in name)
    if not name.isidentifier():
        name = f"_{name}"
    while name in FIELDS or name in taken:
        name += "_"
    return name
