"""Tensors of points that another library holds -> a cloud; what needs no change is shared and not copied."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.contracts.lengths import check_metres
from pcdata.errors import DTypeError, FrameError, NonFiniteError, ShapeError, UnitError, near_matches
from pcdata.io.clouds.arrays import free_name, kind_of_column
from pcdata.structures import METRE, Kind, PointCloud, SurfaceMesh
from pcdata.structures.kinds import FIELDS, KINDS, attributes
from pcdata.structures.point_arrays import held_tensor, metres, unit_colors, unit_normals, whole_labels
from pcdata.structures.structure import derived

_LABELS = ("labels", "label")
_OWN = {"points": (3,), "colors": (3,), "normals": (3,), "labels": (), "source_index": ()}  # shape of a row
_HELD = (torch.float32, torch.float64, torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)


def chosen_fields(where: str, cloud: PointCloud, fields: Sequence[str] | None) -> dict[str, Tensor]:
    """Return the fields that are handed over, points first; None = all.

    Raises:
        DTypeError: a name that the cloud does not have, or values of a type that arrays do not have.
    """
    present = cloud.fields()
    check_texts(where, "fields", fields)
    for name in fields or ():
        if name not in present:
            raise DTypeError(f"{where}: no field {name!r}{near_matches(name, present)}; the cloud has {[*present]}")
    kept = {name: value.detach() for name, value in present.items() if fields is None or name in ("points", *fields)}
    for name, value in kept.items():
        if value.dtype not in _HELD:
            raise DTypeError(f"{where}: {name} is {value.dtype}, which is not handed over; convert it, or say fields=")
    return kept


def check_texts(where: str, argument: str, names: Any) -> None:
    """Require names, or None.

    Raises:
        DTypeError: one text, which is a sequence of letters, or no texts.
    """
    if isinstance(names, str):
        raise DTypeError(f"{where}: {argument} must be names, such as ({names!r},), not one text")
    if names is not None and not (isinstance(names, Collection) and all(isinstance(name, str) for name in names)):
        raise DTypeError(f"{where}: {argument} must be names of fields, got {names!r:.100}")


def vertices_of(where: str, like: Any) -> PointCloud | None:
    """Return the clouds that ``like=`` names, of a mesh its vertices.

    Raises:
        DTypeError: it is neither.
    """
    if like is None or isinstance(like, PointCloud):
        return like
    if isinstance(like, SurfaceMesh):
        return like.vertices
    raise DTypeError(f"{where}: like= must be the cloud or mesh that was handed over, got {type(like).__name__}")


def cloud_of_tensors(
    where: str,
    tensors: Mapping[str, Tensor],
    *,
    frame_id: str | None,
    metres_per_unit: float | None = None,
    unit: str | None = None,
    kinds: Mapping[str, Kind | str] | None = None,
    labels_from: str | None = None,
    like: PointCloud | None = None,
    ptr: Tensor | None = None,
) -> PointCloud:
    """Make a cloud of them; a tensor whose values need no change is shared, not copied.

    Args:
        where: the door, named in errors.
        tensors: "points", and by name what has as many rows.
        frame_id: the frame of the coordinates; None = that of ``like``.
        metres_per_unit: None = floats that must look like metres.
        unit: "normalized" for coordinates that are no lengths; None = that of ``like``, else metres.
        kinds: of fields that are not a cloud's own; others are invariant, a ``confidence`` of bytes a minimum.
        labels_from: the tensor that holds the labels; "" = none, None = ``labels`` or ``label``.
        like: the clouds that were handed over: frame, unit, kinds, the way back to the source, frames, signals, meta
            and history are theirs.
        ptr: (B+1,) row pointers; None = one cloud.

    Raises:
        FrameError, UnitError: nobody states the frame or the unit, or two state another.
        NonFiniteError, ShapeError, DTypeError, CaptureError: the rows cannot be those of a cloud.
    """
    num_clouds = 1 if ptr is None else len(ptr) - 1
    frame = _frame(where, frame_id, like)
    unit = _unit(where, unit, metres_per_unit, like)
    if like is not None and like.num_clouds != num_clouds:
        raise ShapeError(f"{where}: like= has {like.num_clouds} clouds, but there are {num_clouds}")
    named = _named(where, tensors, labels_from)
    stated = {**(like.kinds if like is not None else {}), **{name: Kind(kind) for name, kind in (kinds or {}).items()}}
    if strange := [name for name in kinds or () if name not in named]:
        raise DTypeError(f"{where}: kinds= names {strange}, but the fields are {[*named]}")
    points = named["points"]
    if points.ndim != 2 or points.shape[1] != 3:
        raise ShapeError(f"{where}: points must be (N, 3), got {tuple(points.shape)}")
    scale = _metres(where, points, metres_per_unit, unit)
    rows: dict[str, Tensor] = {}
    found: dict[str, Kind] = {}
    for name, value in named.items():
        if value.shape[:1] != points.shape[:1]:
            raise ShapeError(f"{where}: {name} must have {len(points)} rows, got {tuple(value.shape)}")
        if value.dtype not in _HELD:
            raise DTypeError(f"{where}: {name} is {value.dtype}, which a cloud does not take; convert it")
        if name not in FIELDS:
            found[name] = stated.get(name) or (Kind.POSITION if name == "viewpoint" else kind_of_column(name, value))
        shape = _OWN[name] if name in _OWN else _row_shape(name, value, like)
        rows[name] = _taken(f"{where}: {name}", name, _reshaped(where, name, value, shape), found.get(name), scale)
    facts: dict[str, Any] = {
        **dict.fromkeys(FIELDS),
        **attributes(rows),
        "kinds": found,
        "ptr": ptr,
        "frame_id": frame,
        "unit": unit,
    }
    if like is None:
        return PointCloud(**facts)
    facts["layout"] = None  # rows may be others
    facts["ptr"] = torch.tensor([0, len(points)], device=points.device, dtype=torch.int64) if ptr is None else ptr
    known = derived(like.to(points.device), **facts)
    return PointCloud(**vars(known))  # checked


def _frame(where: str, given: str | None, like: PointCloud | None) -> str:
    if like is None:
        if given is None:
            raise FrameError(
                f"{where}: nothing says which frame the coordinates are in; give frame_id='base', or like= the cloud "
                "that was handed over"
            )
        return given
    if given not in (None, like.frame_id):
        raise FrameError(f"{where}: frame_id={given!r} contradicts like=, which is in {like.frame_id!r}; give one")
    return like.frame_id


def _unit(where: str, given: str | None, metres_per_unit: float | None, like: PointCloud | None) -> str:
    known = METRE if like is None else like.unit
    if like is not None and given not in (None, known):
        raise UnitError(f"{where}: unit={given!r} contradicts like=, which is [{known}]; give one of them")
    unit = given or known
    if metres_per_unit is not None and unit != METRE:
        raise UnitError(f"{where}: metres_per_unit={metres_per_unit!r} contradicts unit={unit!r}; give one of them")
    return unit


def _named(where: str, tensors: Mapping[str, Tensor], labels_from: str | None) -> dict[str, Tensor]:
    """Call them as a cloud calls its fields."""
    if labels_from and labels_from not in tensors:
        raise DTypeError(
            f"{where}: labels_from={labels_from!r} is not there{near_matches(labels_from, tensors)}; there are "
            f"{[*tensors]}"
        )
    labels = labels_from if labels_from is not None else next((name for name in _LABELS if name in tensors), "")
    named = {"points": tensors["points"]}
    for name, value in tensors.items():
        if name == "points":
            continue
        own = name if name in _OWN and name != "labels" else free_name(name, named)
        named["labels" if name == labels else own] = value
    return named


def _metres(where: str, points: Tensor, stated: float | None, unit: str) -> float:
    xyz = points.detach().cpu().numpy()
    if points.dtype not in (torch.float32, torch.float64) and (stated is None or unit != METRE):
        raise UnitError(f"{where}: points are {points.dtype} in a unit that nobody states; give metres_per_unit")
    if bad := int((~np.isfinite(xyz).all(axis=1)).sum()):
        raise NonFiniteError(f"{where}: {bad} of {len(xyz)} points are NaN or infinite; remove them there first")
    return check_metres(where, xyz, stated) if unit == METRE else 1.0


def _row_shape(name: str, value: Tensor, like: PointCloud | None) -> tuple[int, ...]:
    """Return the shape of a row as it was handed over; a column is one value a row."""
    if like is not None and name in like.extra and value.shape[1:].numel() == like.extra[name].shape[1:].numel():
        return tuple(like.extra[name].shape[1:])
    return () if value.ndim == 2 and value.shape[1] == 1 else tuple(value.shape[1:])


def _reshaped(where: str, name: str, value: Tensor, shape: tuple[int, ...]) -> Tensor:
    if value.shape[1:].numel() != torch.Size(shape).numel():
        wanted = ", ".join(map(str, (len(value), *shape)))
        raise ShapeError(f"{where}: {name} must be ({wanted}), got {tuple(value.shape)}")
    return value if tuple(value.shape[1:]) == shape else value.reshape(len(value), *shape)


def _taken(where: str, name: str, value: Tensor, kind: Kind | None, scale: float) -> Tensor:
    """Return the values as a cloud holds them, the tensor itself where that changes none."""
    if name == "colors":
        return _changed(value, lambda array: unit_colors(where, array))
    if name == "normals":
        return _changed(value, unit_normals)
    if name in ("labels", "source_index"):
        return _changed(value, lambda array: whole_labels(where, array))
    if name == "points" or (kind is not None and KINDS[kind].is_length):
        return _changed(value, lambda array: metres(where, array, scale))
    return _changed(value, lambda array: held_tensor(where, array).numpy())


def _changed(value: Tensor, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Tensor:
    array = value.detach().cpu().numpy()
    made = change(array)
    if made.dtype == array.dtype and np.array_equal(made, array, equal_nan=made.dtype.kind == "f"):
        return value.detach()
    return torch.from_numpy(made).to(value.device)
