"""A chain as it is written down: a list of ``{TransformName: fields}``, or such lists in sections.

The sections ``depth``, ``cloud`` and ``augment`` stand for one list, in this order. Only registered names are known;
nothing is imported and nothing is run. Every fault is reported at once, with its place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pcdata.errors import ConfigError, near_matches
from pcdata.structures import METRE, DepthFrame, PointCloud
from pcdata.transforms.base import REGISTRY, Transform
from pcdata.transforms.field_checks import field_names, field_types, has_fields, validated_fields
from pcdata.transforms.sensor_words import (
    SENSOR,
    check_sensor_unit,
    sensor_fields,
    sensor_from_node,
    sensor_hint,
    sensor_value,
)
from pcdata.yaml_nodes import Document

SECTIONS = ("depth", "cloud", "augment")
_MAX_STEPS = 1000  # of one list; each is built, which takes some 200 microseconds

Placed = tuple[Transform, Any]  # a step, and the node that it was read from


def steps_of_document(document: Document, node: Any) -> list[Placed]:
    """Build the steps of a list or of sections; faults are noted in the document and the faulty steps left out."""
    if not document.is_mapping(node):
        return _steps_of_list(document, node, "a pipeline")
    entries = document.mapping(node, "a pipeline")
    for section, (key, _) in entries.items():
        if section not in (*SECTIONS, SENSOR):
            hint = "; a list of steps has '- ' before each" if section in REGISTRY else ""
            document.fault(key, f"unknown section {section!r}; a pipeline has {', '.join(SECTIONS)}{hint}")
    return steps_of_sections(document, entries)


def steps_of_sections(document: Document, entries: Mapping[str, tuple[Any, Any]]) -> list[Placed]:
    """Build the steps of the sections; a step in the wrong one is told where it belongs."""
    if SENSOR in entries:
        document.sensor = sensor_from_node(document, entries[SENSOR][1])
    before = len(document.faults)
    sections = {
        section: _steps_of_list(document, entries[section][1], f"section {section}")
        for section in SECTIONS
        if section in entries
    }
    for section, placed in sections.items():
        gives: type = DepthFrame if section == "depth" else PointCloud
        for step, node in placed:
            if not issubclass(gives, step.takes):
                right = "cloud" if section == "depth" else "depth"
                way = f"it belongs into the section {right}, not {section}"
                if section == "depth" and not issubclass(step.takes, PointCloud):
                    way = "the steps before it give a cloud already: put it before them, or leave it out"
                document.fault(node, f"{type(step).__name__} takes a {step.takes.__name__}; {way}")
                break
            gives = step.gives
    if sections.get("depth") and (sections.get("cloud") or sections.get("augment")):
        step, node = sections["depth"][-1]
        if step.gives is not PointCloud and len(document.faults) == before:
            document.fault(node, "the section depth must end in points; put Deproject last")
    return [one for placed in sections.values() for one in placed]


def _steps_of_list(document: Document, node: Any, what: str) -> list[Placed]:
    items = document.sequence(node, what)
    if len(items) > _MAX_STEPS:
        document.fault(node, f"{what} has {len(items)} steps; at most {_MAX_STEPS} are read")
        return []
    placed = []
    for item in items:
        step = _step_of_node(document, item)
        if step is not None:
            placed.append((step, item))
    return placed


def _step_of_node(document: Document, node: Any) -> Transform | None:
    """Build one step written as ``Name`` or ``{Name: fields}``."""
    name = document.word(node)
    name_node, fields_node = node, None
    if name is None:
        if not document.is_mapping(node):
            document.fault(node, "a step must be a name, or a name with its fields, not a list")
            return None
        entries = document.mapping(node, "a step")
        if len(entries) != 1:
            document.fault(node, f"a step is one name with its fields, got {len(entries)} names: {sorted(entries)}")
            return None
        ((name, (name_node, fields_node)),) = entries.items()
    cls = REGISTRY.get(name)
    if cls is None:
        hint = near_matches(name, REGISTRY) or f"; known: {', '.join(sorted(REGISTRY))}"
        document.fault(name_node, f"unknown transform {name!r}{hint}; one of your own needs --import FILE.py")
        return None
    return _build(document, cls, name_node, fields_node)


def _build(document: Document, cls: type[Transform], name_node: Any, fields_node: Any) -> Transform | None:
    before = len(document.faults)
    entries = document.mapping(fields_node, cls.__name__)
    fields: dict[str, Any] = {}
    for key, (_, value) in entries.items():
        known = len(document.faults)
        read = _field_value(document, cls, key, value)
        if len(document.faults) == known:
            fields[key] = read
    if fields.get("unit", METRE) != METRE:
        check_sensor_unit(document, cls, {key: node for key, (_, node) in entries.items()}, fields)
    try:
        if len(document.faults) == before and has_fields(cls, fields):
            return cls(**fields)
        validated_fields(cls, fields)  # says what is missing, unknown or wrong, besides what could not be read
    except ConfigError as error:
        if not error.faults:  # rules that bind several fields
            document.fault(name_node, str(error))
        for path, message in error.faults:
            if path and str(path[0]) in entries and str(path[0]) not in fields:
                continue  # not missing: it could not be read, and that was said
            place = ".".join(map(str, (cls.__name__, *path)))
            hint = sensor_hint(fields.get(str(path[0]))) if path else ""
            document.fault(_place(document, cls, entries, fields_node, name_node, path), f"{place}: {message}{hint}")
    return None


def _field_value(document: Document, cls: type[Transform], key: str, node: Any) -> Any:
    """Read one field; fields that hold transforms are steps themselves."""
    declared = field_types(cls).get(key)
    if declared is Transform:
        return _step_of_node(document, node)
    if declared == Sequence[Transform]:
        return [step for step, _ in _steps_of_list(document, node, f"{cls.__name__}.{key}")]
    if key in sensor_fields(cls) and document.word(node) == SENSOR:
        return sensor_value(document, node, cls, key)
    return document.plain(node)


def _place(
    document: Document,
    cls: type[Transform],
    entries: Mapping[str, tuple[Any, Any]],
    fields_node: Any,
    name_node: Any,
    path: Sequence[int | str],
) -> Any:
    """Point at the value where there is one, at an unknown field's name, else at the step."""
    if not path or str(path[0]) not in entries:
        return fields_node if entries else name_node
    key, value = entries[str(path[0])]
    return key if path[0] not in field_names(cls) else document.at(value, path[1:])
