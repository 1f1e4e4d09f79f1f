"""Arrays of points as programs hold them -> the numbers of a cloud: metres, colors in 0..1, unit normals, labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from pcdata.contracts.lengths import check_metres, ways, width_of_points
from pcdata.errors import CaptureError, DTypeError, NonFiniteError, ShapeError, UnitError, near_matches
from pcdata.structures.kinds import FIELDS, KINDS, METRE, Kind, attributes, kind_of

_ROUNDED = 1e-5  # that a float color may lie above 1
_FINEST = 5e-4  # metres that storing float64 coordinates as float32 may move a point
_COLUMNS = {"colors": (3,), "normals": (3,), "labels": (), "source_index": ()}  # of one row
# What torch can hold and compute with; unsigned integers go to the next wider signed type.
_HOLDABLE = {"u1": "u1", "i1": "i1", "u2": "i4", "i2": "i2", "u4": "i8", "i4": "i4", "u8": "i8", "i8": "i8"}


def metres(where: str, xyz: NDArray[Any], unit: float) -> NDArray[np.float32]:
    """Return (N, 3) coordinates of a unit as float32 metres.

    Raises:
        CaptureError: they are so large that float32 would move them.
    """
    wide = xyz.astype(np.float64) * unit
    with np.errstate(over="ignore"):
        points = wide.astype(np.float32)
    if xyz.dtype != np.float32 and len(wide) and not float(np.abs(points - wide).max()) <= _FINEST:
        raise CaptureError(
            f"{where}: coordinates reach {np.abs(wide).max():.6g} m, where float32 moves points by more than "
            f"{_FINEST:g} m; subtract a common offset (a map origin) before saving"
        )
    return points


def unit_colors(where: str, rgb: NDArray[Any]) -> NDArray[np.float32]:
    """Return colors in 0..1: bytes, 16 bits, whole numbers up to 255 of any type, or floats that are in 0..1 already.

    Whole numbers that reach beyond 1 and not beyond 255 are bytes in a wider type: no other scale has them.
    """
    if not len(rgb) or rgb.dtype == np.uint8:
        return (rgb / np.float32(255)).astype(np.float32)
    low, high = float(rgb.min()), float(rgb.max())
    is_float = rgb.dtype.kind == "f"
    if is_float and low >= 0 and high <= 1 + _ROUNDED:
        return np.minimum(rgb.astype(np.float32), np.float32(1))
    if low >= 0 and high <= 255 and (not is_float or bool((rgb == np.rint(rgb)).all())):
        return (rgb / np.float32(255)).astype(np.float32)
    if rgb.dtype.kind == "u" and rgb.dtype.itemsize == 2:
        return (rgb / np.float32(65535)).astype(np.float32)
    raise CaptureError(
        f"{where}: colors must be whole numbers in 0..255 or unsigned 16 bits, or floats in 0..1, got {rgb.dtype} "
        f"{low:g} .. {high:g}; rescale them when exporting"
    )


def unit_normals(normals: NDArray[Any]) -> NDArray[np.float32]:
    """Return (N, 3) directions at unit length; NaN and infinite ones become zero vectors."""
    with np.errstate(over="ignore", invalid="ignore"):
        unit = normals.astype(np.float32)
        unit[~np.isfinite(unit).all(axis=1)] = 0.0
        length = np.linalg.norm(unit.astype(np.float64), axis=1)
    off = (np.abs(length - 1.0) > 1e-3) & (length > 0)
    unit[off] = unit[off] / length[off, None]
    return unit


def whole_labels(where: str, labels: NDArray[Any]) -> NDArray[np.int64]:
    """Return (N,) labels as int64.

    Raises:
        CaptureError: they are not one whole number per point.
    """
    if labels.ndim != 1:
        raise CaptureError(f"{where}: a label must be one number per point, got {labels.shape[1]}")
    if labels.dtype.kind == "f" and not (np.isfinite(labels).all() and (labels == np.rint(labels)).all()):
        raise CaptureError(f"{where}: labels must be whole numbers, but some are not; rename the field if a score")
    if labels.dtype.kind != "i" and len(labels) and not int(labels.max()) < 2**63:
        raise CaptureError(f"{where}: labels reach {labels.max()}, above what int64 holds")
    return labels.astype(np.int64)


def held_tensor(where: str, values: NDArray[Any]) -> torch.Tensor:
    """Copy an array into a tensor of its dtype, or of the next wider signed one where torch has no such integers."""
    native = values.dtype.newbyteorder("=")
    if native.kind in "iu":
        if native == np.uint64 and len(values) and values.max() >= 2**63:
            raise CaptureError(f"{where}: values reach {values.max()}, above what int64 holds")
        native = np.dtype(_HOLDABLE[native.str[1:]])
    return torch.from_numpy(np.array(values, dtype=native))


def attributes_of_arrays(
    where: str,
    arrays: Mapping[str, ArrayLike | None],  # "points", "ptr", "viewpoint" and fields of N rows, by name
    kinds: Mapping[str, Kind | str],  # of the fields that are not a cloud's own
    metres_per_unit: float | None,
    unit: str,
) -> dict[str, Any]:
    """Copy arrays into what a cloud is made of, lengths as metres; ``viewpoint`` may be per cloud or per point.

    Raises:
        ShapeError: points are not (N, 3).
        UnitError, NonFiniteError: as the unit of the coordinates is found.
        DTypeError: no array of numbers, or a field whose kind nobody states.
        CaptureError: colors, labels or coordinates that cannot be meant.
    """
    given = {name: np.asarray(value) for name, value in arrays.items() if value is not None}
    xyz, ptr, seen_from = given["points"], given.pop("ptr", None), given.pop("viewpoint", None)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise ShapeError(f"{where}: points must be (N, 3), got {xyz.shape}; of an image of points .reshape(-1, 3)")
    if ptr is not None and ptr.dtype.kind not in "iu":
        raise DTypeError(f"{where}: ptr must be whole numbers, got {ptr.dtype}")
    known = {name: Kind(kind) for name, kind in kinds.items()}
    length = _metres_per_unit(where, xyz, metres_per_unit, unit, seen_from)
    if seen_from is not None:
        num_clouds = 1 if ptr is None else len(ptr) - 1
        seen_from = seen_from[None] if seen_from.shape == (3,) and num_clouds == 1 else seen_from
        if seen_from.shape == xyz.shape and len(xyz) != num_clouds:
            given["viewpoint"], known["viewpoint"], seen_from = seen_from, Kind.POSITION, None
        elif seen_from.shape != (num_clouds, 3):
            raise ShapeError(
                f"{where}: viewpoint must be ({num_clouds}, 3), one per cloud, or {xyz.shape}, one per point, got "
                f"{seen_from.shape}"
            )
    return {
        **attributes(_point_tensors(where, given, known, length)),
        "kinds": {name: kind for name, kind in known.items() if name in given},
        "ptr": None if ptr is None else torch.from_numpy(ptr.astype(np.int64)),
        "viewpoint": None if seen_from is None else torch.from_numpy(metres(f"{where}: viewpoint", seen_from, length)),
    }


def _point_tensors(
    where: str, fields: Mapping[str, NDArray[Any]], kinds: Mapping[str, Kind], unit: float
) -> dict[str, torch.Tensor]:
    tensors: dict[str, torch.Tensor] = {}
    num_points = len(fields["points"])
    for name, values in fields.items():
        if values.dtype.kind not in "biuf":
            raise DTypeError(f"{where}: {name} must be an array of numbers, got {values.dtype}")
        if name not in FIELDS and name not in kinds:
            raise DTypeError(
                f"{where}: no field {name!r}{near_matches(name, FIELDS)}; of a field of your own say what it is, "
                f"kinds={{{name!r}: ...}}, one of {', '.join(repr(kind.value) for kind in KINDS)}"
            )
        of = f"{where}: {name}"
        columns = _COLUMNS.get(name, values.shape[1:])
        if values.shape[:1] != (num_points,) or values.shape[1:] != columns:
            wanted = ", ".join(map(str, (num_points, *columns)))
            raise ShapeError(f"{of} must be ({wanted}) for {num_points} points, got {values.shape}")
        if name == "colors":
            tensors[name] = torch.from_numpy(unit_colors(of, values))
        elif name == "normals":
            tensors[name] = torch.from_numpy(unit_normals(values))
        elif name in ("labels", "source_index"):
            tensors[name] = torch.from_numpy(whole_labels(of, values))
        elif KINDS[kind_of(name, kinds)].is_length:
            tensors[name] = torch.from_numpy(metres(of, values, unit))
        else:
            tensors[name] = held_tensor(of, values)
    return tensors


def _metres_per_unit(
    where: str, xyz: NDArray[Any], stated: float | None, unit: str, viewpoint: ArrayLike | None
) -> float:
    """Return the factor that brings (N, 3) coordinates to metres, or to what a normalization left: 1.

    Raises:
        UnitError: whole numbers without a unit, or coordinates that do not look like metres.
        NonFiniteError: NaN or infinite coordinates.
    """
    if xyz.dtype.kind not in "iuf":
        raise DTypeError(f"{where}: points must be numbers, got {xyz.dtype}")
    if bad := int((~np.isfinite(xyz).all(axis=1)).sum()):
        raise NonFiniteError(
            f"{where}: {bad} of {len(xyz)} points are NaN or infinite; keep = np.isfinite(points).all(axis=1), and "
            "give points[keep] and the same rows of every other field"
        )
    if unit != METRE:
        if stated is not None:
            raise UnitError(f"{where}: metres_per_unit={stated!r} contradicts unit={unit!r}; give one of them")
        return 1.0
    if stated is None and xyz.dtype.kind != "f":
        raise UnitError(
            f"{where}: points are {xyz.dtype} in a unit that nobody states; {ways(width_of_points(xyz) or 1000.0)}"
        )
    seen_from = (0.0, 0.0, 0.0) if viewpoint is None else np.asarray(viewpoint, np.float64).reshape(-1, 3).mean(axis=0)
    return check_metres(where, xyz, stated, viewpoint=seen_from)


def signals_of_arrays(where: str, signals: Mapping[str, Sequence[Any]]) -> dict[str, tuple[Any, ...]]:
    """Copy what a program holds of one moment: name -> values with a leading 1, kind and maybe frame.

    Raises:
        DTypeError: not (values, kind) or (values, kind, frame), or values that are no numbers.
    """
    made: dict[str, tuple[Any, ...]] = {}
    given: Any = signals  # whatever the annotations promise
    if not isinstance(given, Mapping):
        found = type(signals).__name__
        raise DTypeError(f"{where}: signals must be a mapping, name -> (values, kind, frame), got {found}")
    for name, said in signals.items():
        of = f"{where}: signals[{name!r:.200}]"
        if (
            isinstance(said, (str, np.ndarray, torch.Tensor))
            or not isinstance(said, Sequence)
            or len(said) not in (2, 3)
        ):
            raise DTypeError(f"{of}: must be (values, kind) or (values, kind, frame), got {type(said).__name__}")
        values, *rest = said
        if isinstance(values, str):
            made[name] = ((values,), *rest)
            continue
        try:
            array = values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else np.asarray(values)
        except (ValueError, TypeError) as error:
            raise DTypeError(f"{of}: is no array of numbers: {error!s:.200}") from error
        if array.dtype.kind not in "biuf" or array.dtype.itemsize > 8:
            raise DTypeError(f"{of}: must be an array of numbers or a text, got {array.dtype}")
        made[name] = (held_tensor(of, array[None]), *rest)
    return made
