"""What the named columns of a cloud file mean: coordinates, normals, colors, labels, extra fields.

Names are those that CloudCompare, MeshLab, Open3D, PCL, Blender and the common data sets write, in any case, with or
without the prefixes ``scalar_`` and ``vertex_``. What a name could mean twice is asked about, never guessed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError, near_matches
from pcdata.io.clouds.arrays import CloudArrays
from pcdata.io.clouds.statement import SCALAR, CloudStatement
from pcdata.structures import Kind

Columns = dict[str, NDArray[Any]]  # (N,), or (N, C) where a format has columns of several values

_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"), ("normalx", "normaly", "normalz"))
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_PACKED = ("rgb", "rgba")
# More triples that move with the cloud, as PCL writes them.
_MOVING = {
    "viewpoint": (("vp_x", "vp_y", "vp_z"), Kind.POSITION),
    "principal_curvature": (
        ("principal_curvature_x", "principal_curvature_y", "principal_curvature_z"), Kind.DIRECTION),
}  # fmt: skip

_THINGS = (
    "label", "class", "cls", "category", "classification", "semantic", "segment", "segmentation", "seg", "cluster",
    "instance", "inst", "ins", "object", "obj", "part",
)  # fmt: skip
_ENDINGS = ("", "s", "es", "id", "ids", "label", "labels", "class")
_LABELS = {f"{thing}{ending}" for thing in _THINGS for ending in _ENDINGS}
_LABELS |= {"categories", "semanticid", "semlabel", "semid", "groundtruth", "gt", "gtlabel", "annotation", "predlabel"}
_LABELS |= {"prediction", "predictedlabel", "predictedclass", "predclass", "objectlabel", "trueclass", "truelabel"}
_LABELS |= {"labelid", "labelindex", "classindex"}

# Parts of names of quantities that may be averaged although a sensor writes whole numbers of them.
_MEASURED = (
    "intensity|reflect|remission|amplitude|confidence|quality|score|prob|time|stamp|dist|range|depth|height|elevation|"
    "altitude|curvature|angle|azimuth|radius|weight|density|temperature|gr[ae]y|lumin|alpha|noise|error|deviation|"
    "uncertainty|variance|roughness|^[suvt]$|scale|opacity|^f_|^rot_"
)


@np.errstate(invalid="ignore", over="ignore")  # NaNs of every kind are judged by value
def arrays_of_columns(
    where: str, columns: Columns, statement: CloudStatement, *, labels_from: str | None = None
) -> CloudArrays:
    """Give the columns their meaning by name; the rest are extra fields.

    Args:
        where: the file, named in errors.
        columns: by the names in the file; is used up.
        statement: what the file says about itself.
        labels_from: the column that holds the labels; "" = none of them, None = found by its name.

    Raises:
        CaptureError: coordinates are missing; a vector is incomplete; two columns may be the same thing; labels are not
            whole numbers.
    """
    found = " ".join(columns)[:300] or "none"
    xyz = _triple(columns, ("x", "y", "z"))
    if xyz is None:
        raise CaptureError(f"{where}: fields x, y and z are needed, one value each, but the file has {found}")
    if statement.quality is not None:
        columns.pop("quality", None)  # a copy for other programs
    stated = {name: _stated(where, name, columns, statement) for name in statement.fields}
    normals = _one_triple(where, columns, _NORMALS, "normals")
    rgb = _one_triple(where, columns, _COLORS, "colors")
    packed = [name for name in columns if name.lower() in _PACKED and columns[name].dtype.itemsize == 4]
    if rgb is None and packed:
        rgb = _unpacked(where, packed[0], columns.pop(packed[0]))
    name = _label_name(where, columns, statement, labels_from)
    labels = None if name is None else _whole_labels(where, name, columns.pop(name))
    extra = dict(stated)
    kinds = {name: fact.kind for name, fact in statement.fields.items()}
    for name, (names, kind) in _MOVING.items():
        triple = _one_triple(where, columns, (names,), name)
        if triple is not None:
            extra[name], kinds[name] = triple.astype(np.float32), kind
    for name, column in columns.items():
        extra[name] = _counted(name, column)
    return CloudArrays(
        xyz=xyz if xyz.dtype.kind == "f" else xyz.astype(np.float64),
        normals=None if normals is None else normals.astype(np.float64),
        rgb=rgb,
        labels=labels,
        extra=extra,
        kinds=kinds,
    )


# -- triples -----------------------------------------------------------------------------------------------------------


def _column(columns: Columns, wanted: str) -> str | None:
    """Return the name of a column of one value, exactly or else in another case."""
    fitting = [name for name in columns if name.lower() == wanted and columns[name].ndim == 1]
    return wanted if wanted in fitting else fitting[0] if len(fitting) == 1 else None


def _triple(columns: Columns, wanted: Iterable[str]) -> NDArray[Any] | None:
    names = [_column(columns, name) for name in wanted]
    if any(name is None for name in names):
        return None
    return np.stack([columns.pop(name) for name in names if name is not None], axis=1)


def _one_triple(where: str, columns: Columns, choices: Iterable[tuple[str, ...]], what: str) -> NDArray[Any] | None:
    """Take the columns of a vector or a color; a part of one, or two of them, cannot be told what they are."""
    present = {names: [name for name in names if _column(columns, name)] for names in choices}
    whole = [names for names, own in present.items() if len(own) == 3]
    if len(whole) > 1:
        raise CaptureError(
            f"{where}: {' '.join(whole[0])} and {' '.join(whole[1])} may both be the {what}; remove or rename one"
        )
    if whole:
        return _triple(columns, whole[0])
    for names, own in present.items():
        if len(own) == 2:
            missing = next(name for name in names if name not in own)
            raise CaptureError(
                f"{where}: {' '.join(own)} look like {what}, but {missing} is missing"
                f"{near_matches(missing, columns)}; they would not move with the cloud: name all three, or rename two"
            )
    return None


def _unpacked(where: str, name: str, column: NDArray[Any]) -> NDArray[np.uint8]:
    """Split 0xAARRGGBB, stored as an integer or as the float of the same bits, into (N, 3)."""
    if column.ndim != 1:
        raise CaptureError(f"{where}: field {name!r} must be four bytes per point, got {column.shape[1]} values")
    order = ">u4" if column.dtype.byteorder == ">" else "<u4"
    packed = np.ascontiguousarray(column).view(order)
    return np.stack([(packed >> shift & 255).astype(np.uint8) for shift in (16, 8, 0)], axis=1)


# -- labels ------------------------------------------------------------------------------------------------------------


def plain_name(name: str) -> str:
    """Return a name in lower case, without the prefixes that programs add, blanks and signs."""
    return re.sub(r"[^a-z0-9]", "", re.sub(r"^(scalar|vertex|point|sf)[ _-]+", "", name.lower()))


def _label_name(where: str, columns: Columns, statement: CloudStatement, labels_from: str | None) -> str | None:
    """Return the column that holds the labels."""
    if labels_from == "":
        return None
    if labels_from is not None:
        fitting = [name for name in columns if name == labels_from]
        fitting = fitting or [name for name in columns if name.lower() == labels_from.lower()]
        fitting = fitting or [name for name in columns if plain_name(name) == plain_name(labels_from)]
        if len(fitting) == 1:
            return fitting[0]
        hint = near_matches(labels_from, columns)
        raise CaptureError(
            f"{where}: labels_from={labels_from!r} names no column, or several{hint}; there are "
            f"{' '.join(columns)[:300] or 'none besides the coordinates'}"
        )
    if statement.frame_id is not None:  # a file of pcdata says which column it is
        if statement.labels is None or statement.labels in columns:
            return statement.labels
        if f"{SCALAR}{statement.labels}" in columns:
            return f"{SCALAR}{statement.labels}"
        raise CaptureError(f"{where}: the column {statement.labels!r} of its labels is missing")
    fitting = [name for name in columns if plain_name(name) in _LABELS and columns[name].ndim == 1]
    if len(fitting) > 1:
        raise CaptureError(
            f"{where}: {' and '.join(map(repr, fitting[:8]))} may all be the labels; say which with labels_from="
            f"{fitting[0]!r} (the others stay extra fields), or labels_from='' for none"
        )
    return fitting[0] if fitting else None


def _whole_labels(where: str, name: str, column: NDArray[Any]) -> NDArray[Any]:
    if column.ndim != 1:
        raise CaptureError(f"{where}: a label must be one number per point, but {name!r} has {column.shape[1]}")
    if column.dtype.kind == "f":
        unknown = int(np.isnan(column).sum())
        if unknown:
            raise CaptureError(
                f"{where}: {unknown} of {len(column)} points have no number in the column of labels {name!r}; give "
                "them one, such as -1, or pass labels_from='' to keep it as an extra field"
            )
        if not _is_whole(column):
            raise CaptureError(
                f"{where}: labels must be whole numbers, but {name!r} has others, such as "
                f"{column[column != np.rint(column)][:1]}; pass labels_from='' to keep it as an extra field, or the "
                "name of the right column"
            )
    return column


def _is_whole(column: NDArray[Any]) -> bool:
    return bool((np.abs(column) < 2**53).all() and (column == np.rint(column)).all())


# -- extra fields ------------------------------------------------------------------------------------------------------


def _counted(name: str, column: NDArray[Any]) -> NDArray[Any]:
    """Return whole numbers that a program wrote as floats as integers, so that they are voted and never averaged.

    Quantities known by name stay as they are.
    """
    if column.dtype.kind != "f" or column.ndim != 1 or not len(column) or re.search(_MEASURED, name.lower()):
        return column
    return column.astype(np.int64) if _is_whole(column) else column


def _stated(where: str, name: str, columns: Columns, statement: CloudStatement) -> NDArray[Any]:
    """Return an extra field that pcdata wrote, as it was."""
    fact = statement.fields[name]
    names = [name] if name in columns or not fact.columns else [f"{name}_{i}" for i in range(fact.columns)]
    if names[0] not in columns and f"{SCALAR}{names[0]}" in columns:
        names = [f"{SCALAR}{one}" for one in names]
    missing = [part for part in names if part not in columns]
    if missing:
        raise CaptureError(f"{where}: the comments name the field {name!r}, but its column {missing[0]!r} is missing")
    parts = [columns.pop(part) for part in names]
    values = parts[0] if len(parts) == 1 else np.stack(parts, axis=1)
    if fact.columns and values.ndim == 1:
        values = values[:, None]
    if values.shape[1:] != (() if not fact.columns else (fact.columns,)):
        raise CaptureError(
            f"{where}: the comments give the field {name!r} {fact.columns} columns, got {values.shape[1:]}"
        )
    with np.errstate(all="ignore"):
        typed = values.astype(fact.dtype)
    if not np.array_equal(typed.astype(values.dtype), values, equal_nan=values.dtype.kind == "f"):
        raise CaptureError(
            f"{where}: the comments say that the field {name!r} is {fact.dtype}, but its values do not fit"
        )
    return typed
