"""What a cloud file says about itself in comments: frame, unit, viewpoint, the way back to the source, extra fields.

PLY and PCD have no place for these, but both have comments, which every reader skips. pcdata writes one fact a line,
``pcdata KEY JSON``. Comments of others are read for one thing: a unit that they name.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pcdata.contracts.lengths import UNITS
from pcdata.errors import CaptureError, DTypeError, FrameError, PcdataError, UnitError
from pcdata.files.strict_json import parse_json
from pcdata.geometry import rigid
from pcdata.structures import CAMERA_FRAME, METRE, NORMALIZED, Kind, PointCloud

SCALAR = "scalar_"  # what CloudCompare puts before the names of scalar fields
_MARK = "pcdata "
_LONGEST = 900  # characters: rply, and Open3D's reader of PCD, cut lines at 1024
_MOST = 100  # frames, or fields
_DTYPES = ("float32", "float64", "uint8", "int8", "int16", "int32", "int64", "bool")
_UNIT_WORDS = {
    "m": "metres", "meter": "metres", "meters": "metres", "metre": "metres", "metres": "metres",
    "mm": "millimetres", "millimeter": "millimetres", "millimeters": "millimetres", "millimetre": "millimetres",
    "millimetres": "millimetres", "cm": "centimetres", "centimeter": "centimetres", "centimeters": "centimetres",
    "centimetre": "centimetres", "centimetres": "centimetres", "inch": "inches", "inches": "inches",
}  # fmt: skip
_NAMED_UNIT = re.compile(
    r"\b(?:units?|in)\b[\s:=\"'(]*(?:is|are|in)?[\s:=\"'(]*\b(" + "|".join(_UNIT_WORDS) + r")\b", re.IGNORECASE
)


@dataclass(frozen=True)
class _FieldFacts:
    """How an extra field was held: its kind, dtype, and number of columns (0 = one value per point)."""

    kind: Kind
    dtype: str
    columns: int


@dataclass
class CloudStatement:
    """What the comments of a file say; None or empty where they say nothing."""

    frame_id: str | None = None
    unit: str | None = None
    viewpoint: list[float] | None = None
    labels: str | None = None  # the column that holds them
    quality: str | None = None  # the field of which the column "quality" is a copy
    source_frame: str | None = None
    source_from_cloud: Tensor | None = None
    frames: dict[str, Tensor] = field(default_factory=dict)
    fields: dict[str, _FieldFacts] = field(default_factory=dict)
    named_unit: tuple[str, str] | None = None  # the unit that somebody else's comment names, and the comment

    def frame(self, where: str, given: str | None) -> str:
        """Return the frame of the coordinates: as stated by the file or the caller, else the camera's.

        Raises:
            FrameError: they contradict each other.
        """
        if given is not None and self.frame_id is not None and given != self.frame_id:
            raise FrameError(
                f"{where}: says that it is in frame {self.frame_id!r}, but frame_id={given!r} was given; leave "
                "frame_id out, or move the cloud with ToFrame after reading"
            )
        return given or self.frame_id or CAMERA_FRAME

    def metres_per_unit(self, where: str, given: float | None) -> float | None:
        """Return the unit of the coordinates as stated by the file or the caller, None where nobody says.

        Raises:
            UnitError: they contradict each other, or the file names a unit that is not the metre.
        """
        if self.unit is not None:
            if given not in (None, 1.0):
                raise UnitError(
                    f"{where}: says that it is {'in metres' if self.unit == METRE else self.unit}, but "
                    f"metres_per_unit={given!r} was given; leave it out"
                )
            return 1.0
        if given is None and self.named_unit is not None:
            name, comment = self.named_unit
            if name != "metres":
                raise UnitError(
                    f"{where}: a comment names {name}: {comment!r:.100}; pass metres_per_unit={UNITS[name]:g}, or "
                    "metres_per_unit=1.0 if it does not mean the coordinates"
                )
            return 1.0
        return given


def statement_lines(where: str, cloud: PointCloud, labels: str, quality: str | None = None) -> list[str]:
    """Return what :func:`read_statement` reads, one fact a line, ASCII.

    Args:
        where: the door, named in the error.
        cloud: a single cloud.
        labels: what the column of its labels is called.
        quality: the field that is there once more as the column "quality".

    Raises:
        CaptureError: a name is too long for a line, or there are too many.
    """
    facts: list[tuple[str, Any]] = [("frame_id", cloud.frame_id), ("unit", cloud.unit)]
    facts.append(("viewpoint", None if cloud.viewpoint is None else cloud.viewpoint[0].tolist()))
    if cloud.labels is not None:
        facts.append(("labels", labels))
    if quality is not None:
        facts.append(("quality", quality))
    identity = torch.eye(4, dtype=torch.float64, device="cpu")
    moved = not torch.equal(cloud.source_from_cloud[0].cpu(), identity)
    if moved or cloud.source_frame != cloud.frame_id:
        facts.append(("source_frame", cloud.source_frame))
        facts.append(("source_from_cloud", cloud.source_from_cloud[0].tolist()))
    facts += [("frame", [name, matrix[0].tolist()]) for name, matrix in cloud.frames.items()]
    for name, value in cloud.extra.items():
        dtype = str(value.dtype).removeprefix("torch.")
        if dtype not in _DTYPES:
            raise DTypeError(f"{where}: {name}: a file holds {', '.join(_DTYPES)}, got {dtype}; convert it")
        facts.append(("field", [name, cloud.kinds[name].value, dtype, 0 if value.ndim == 1 else value.shape[1]]))
    if max(len(cloud.frames), len(cloud.extra)) > _MOST:
        raise CaptureError(f"{where}: a file holds at most {_MOST} extra fields and frames; drop some")
    lines = [f"{_MARK}{key} {json.dumps(value)}" for key, value in facts]
    for line in lines:
        if len(line) > _LONGEST:
            raise CaptureError(f"{where}: a name is too long for a line of the header: {line:.80}...; shorten it")
    return lines


def read_statement(where: str, comments: Iterable[str]) -> CloudStatement:
    """Read the comments of a file.

    Raises:
        CaptureError: a line that pcdata writes is damaged.
    """
    found = CloudStatement()
    seen: set[str] = set()
    for comment in comments:
        if not comment.startswith(_MARK):
            unit = _NAMED_UNIT.search(comment)
            if unit and found.named_unit is None:
                found.named_unit = _UNIT_WORDS[unit[1].lower()], comment
            continue
        key, _, text = comment[len(_MARK) :].partition(" ")
        try:
            if key in seen:
                raise ValueError("it is there twice")
            _take(found, key, parse_json(text))
        except (ValueError, TypeError, KeyError, PcdataError) as error:
            raise CaptureError(
                f"{where}: the comment {comment!r:.120} is damaged ({error!s:.120}); correct it, or delete every "
                "comment that begins with 'pcdata' and state frame and unit when reading"
            ) from error
        if key not in ("frame", "field"):
            seen.add(key)
    incomplete = (found.source_from_cloud is None) != (found.source_frame is None)
    if incomplete or (seen and not {"frame_id", "unit", "viewpoint"} <= seen):
        raise CaptureError(f"{where}: some of the comments that begin with 'pcdata' are missing; delete the others too")
    return found


def _take(found: CloudStatement, key: str, value: Any) -> None:
    """Store one fact, checked."""
    if key in ("frame_id", "source_frame", "labels", "quality"):
        setattr(found, key, _text(value))
    elif key == "unit":
        if value not in (METRE, NORMALIZED):
            raise ValueError(f"no unit {value!r:.40}")
        found.unit = value
    elif key == "viewpoint":
        found.viewpoint = None if value is None else _numbers(value, (3,)).tolist()
    elif key == "source_from_cloud":
        found.source_from_cloud = _matrix(value)
        rigid.check_affine("it", found.source_from_cloud[None])
    elif key == "frame":
        name, matrix = value
        pose = _matrix(matrix)
        rigid.check_rigid("it", pose)
        found.frames[_new(_text(name), found.frames)] = pose
    elif key == "field":
        name, kind, dtype, columns = value
        if dtype not in _DTYPES or type(columns) is not int or not 0 <= columns <= 1 << 16:
            raise ValueError(f"{columns!r:.40} columns of {dtype!r:.40}")
        found.fields[_new(_text(name), found.fields)] = _FieldFacts(Kind(kind), dtype, columns)
    else:
        raise ValueError(f"no such fact {key!r:.40}")


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value:
        raise ValueError("a name is needed")
    value.encode()  # raises a ValueError of half a character
    return value


def _new(name: str, known: Sequence[str] | dict[str, Any]) -> str:
    if name in known:
        raise ValueError("it is there twice")
    return name


def _numbers(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = np.array(value, dtype=np.float64)
    if array.shape != shape or not np.abs(array).max() < 1e30:
        raise ValueError(f"finite numbers {shape} are needed")
    return array


def _matrix(value: Any) -> Tensor:
    matrix = torch.from_numpy(_numbers(value, (4, 4)))
    if matrix[3].tolist() != [0, 0, 0, 1] or not abs(float(torch.linalg.det(matrix[:3, :3]))) > 1e-30:
        raise ValueError("an invertible 4x4 is needed")
    return matrix
