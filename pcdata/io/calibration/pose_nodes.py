"""Rigid poses and numbers written in YAML, read with a fault at the place of whatever is wrong."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence

import torch
import yaml
from torch import Tensor

from pcdata.errors import PcdataError, near_matches
from pcdata.geometry import rigid
from pcdata.yaml_nodes import YamlDocument

Entries = Mapping[str, tuple[yaml.Node, yaml.Node]]  # key -> (key node, value node)

POSE_KEYS = ("matrix", "translation", "quaternion_xyzw", "rotation_vector")
_UNIT_QUATERNION = 1e-3  # four decimals; a length further off is a wrong number, not rounding


def known_entries(
    document: YamlDocument,
    node: yaml.Node | None,
    what: str,
    *,
    required: Sequence[str] = (),
    optional: Sequence[str] = (),
) -> Entries:
    """Read a mapping; a key that is unknown or missing is noted as a fault."""
    entries = document.mapping(node, what)
    known = [*required, *optional]
    for key, (key_node, _) in entries.items():
        if key not in known:
            hint = near_matches(key, known) or f"; known: {', '.join(known)}"
            document.fault(key_node, f"{what}: no such key {key!r}{hint}")
    for key in required:
        if key not in entries:
            document.fault(node, f"{what}: {key!r} is missing")
    return {key: entry for key, entry in entries.items() if key in known}


def number(document: YamlDocument, node: yaml.Node, what: str) -> float | None:
    """Read a finite number; None, with the fault noted, when it is none."""
    before = len(document.faults)
    value = document.plain(node)
    if len(document.faults) > before:
        return None
    # Whole numbers may have any length in YAML: the largest float is the limit for them too.
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= sys.float_info.max:
        document.fault(node, f"{what} must be a finite number, got {value!r:.80}")
        return None
    return float(value)


def whole(document: YamlDocument, node: yaml.Node, what: str, *, at_most: int) -> int | None:
    """Read a whole number from 1 to ``at_most``; None, with the fault noted, when it is none."""
    before = len(document.faults)
    value = document.plain(node)
    if len(document.faults) > before:
        return None
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= at_most:
        document.fault(node, f"{what} must be a whole number from 1 to {at_most}, got {value!r:.80}")
        return None
    return value


def numbers(document: YamlDocument, node: yaml.Node, what: str, counts: Sequence[int]) -> list[float] | None:
    """Read a list of as many numbers as one of ``counts``; None, with the fault noted, when it is none."""
    items = document.sequence(node, what)
    if len(items) not in counts:
        document.fault(node, f"{what} must be a list of {' or '.join(map(str, counts))} numbers, got {len(items)}")
        return None
    values = [number(document, item, what) for item in items]
    return None if None in values else values  # type: ignore[return-value]


def pose_from_entries(
    document: YamlDocument,
    node: yaml.Node,  # where to point when something is missing
    entries: Entries,
    what: str,
    check: Callable[[Tensor], None],  # raises a PcdataError for a pose that will not do
) -> Tensor | None:  # (4, 4) float64
    """Read a pose given as ``matrix``, or ``translation`` with ``quaternion_xyzw`` or ``rotation_vector`` (radians).

    None, with the fault noted, when it is none.
    """
    given = [key for key in POSE_KEYS if key in entries]
    if given not in (["matrix"], ["translation", "quaternion_xyzw"], ["translation", "rotation_vector"]):
        document.fault(
            node,
            f"{what}: give matrix alone, or translation with quaternion_xyzw or rotation_vector; got "
            f"{' and '.join(given) or 'none of them'}",
        )
        return None
    values = {key: entries[key][1] for key in given}
    pose = (
        matrix_from_node(document, values["matrix"], what)
        if "matrix" in values
        else _pose_from_parts(document, values, what)
    )
    if pose is None:
        return None
    try:
        check(pose)
    except PcdataError as error:
        document.fault(values[given[0]], str(error))
        return None
    return pose


def matrix_from_node(document: YamlDocument, node: yaml.Node, what: str) -> Tensor | None:  # (4, 4) float64
    """Read four rows of four numbers; None, with the fault noted, when they are none."""
    rows = document.sequence(node, what)
    if len(rows) != 4:
        document.fault(node, f"{what}: a pose has four rows of four numbers, got {len(rows)} rows")
        return None
    read = [numbers(document, row, f"{what}: row {index}", (4,)) for index, row in enumerate(rows)]
    return None if None in read else torch.tensor(read, dtype=torch.float64, device="cpu")


def _pose_from_parts(document: YamlDocument, values: Mapping[str, yaml.Node], what: str) -> Tensor | None:
    translation = numbers(document, values["translation"], f"{what}: translation", (3,))
    if "rotation_vector" in values:
        vector = numbers(document, values["rotation_vector"], f"{what}: rotation_vector", (3,))
        if translation is None or vector is None:
            return None
        if math.hypot(*vector) > 2 * math.pi + 1e-6:
            document.fault(values["rotation_vector"], f"{what}: rotation_vector is in radians; is this in degrees?")
            return None
        rotation = rotation_from_vector(torch.tensor(vector, dtype=torch.float64, device="cpu"))
    else:
        quaternion = numbers(document, values["quaternion_xyzw"], f"{what}: quaternion_xyzw", (4,))
        if translation is None or quaternion is None:
            return None
        if abs(math.hypot(*quaternion) - 1) > _UNIT_QUATERNION:
            length = math.hypot(*quaternion)
            document.fault(values["quaternion_xyzw"], f"{what}: quaternion_xyzw must have length 1, has {length:.6g}")
            return None
        rotation = rigid.rotation_from_quaternion(torch.tensor(quaternion, dtype=torch.float64, device="cpu"))
    return rigid.from_rotation_translation(rotation, torch.tensor(translation, dtype=torch.float64, device="cpu"))


def rotation_from_vector(vector: Tensor) -> Tensor:
    """Return (..., 3, 3) float64 rotations by |v| radians about v (..., 3); the zero vector is no rotation."""
    angle = vector.double().norm(dim=-1)
    axis = vector.double() / torch.where(angle > 0, angle, 1.0)[..., None]
    return rigid.rotation_about_axis(axis, angle)
