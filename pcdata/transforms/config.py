"""Pipelines as YAML: a list of ``{TransformName: fields}``, both ways.

Only registered names are known; nothing is imported and nothing is run. Every fault in a file is reported at once, as
``file:line:column``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from pcdata.errors import ConfigError, near_matches
from pcdata.files.opening import read_text
from pcdata.transforms.base import REGISTRY, Transform
from pcdata.transforms.compose import Compose
from pcdata.transforms.field_checks import field_faults, field_names, field_types
from pcdata.transforms.sensor_words import check_sensor_unit, is_sensor_word, sensor_hint, sensor_value
from pcdata.yaml_nodes import YamlDocument, node_at, yaml_text

_MAX_STEPS = 1000  # of one list; each is built, which takes some 200 microseconds


def pipeline_from_yaml(text: str, *, name: str = "<yaml>") -> Compose:
    """Build a pipeline from a YAML list of steps.

    Raises:
        ConfigError: every fault, as ``name:line:column: what``.
    """
    document = YamlDocument(text, name)
    steps = steps_from_node(document, document.root, "a pipeline")
    document.raise_faults()
    try:
        return Compose(steps)
    except ConfigError as error:  # neighbours that do not fit
        raise ConfigError(f"{name}: {error}") from error


def pipeline_to_yaml(pipeline: Compose) -> str:
    """Write a pipeline as YAML that :func:`pipeline_from_yaml` reads back to an equal one."""
    return yaml_text(pipeline.to_config_list())


def pipeline_from_config(steps: Sequence[Mapping[str, Any] | str]) -> Compose:
    """Build a pipeline from plain data, the form that :meth:`Compose.to_config_list` returns."""
    return pipeline_from_yaml(yaml_text(list(steps)), name="<config>")


def load_pipeline(path: str | Path) -> Compose:
    """Build a pipeline from a YAML file that holds a list of steps."""
    return pipeline_from_yaml(read_config(path), name=str(path))


def read_config(path: str | Path) -> str:
    """Read a configuration file's text.

    Raises:
        ConfigError: the file is missing, not a file, or not UTF-8.
    """
    return read_text("configuration", path, error=ConfigError)


def steps_from_node(document: YamlDocument, node: yaml.Node | None, what: str) -> list[Transform]:
    """Build every step of a list; faults are noted in the document and the faulty steps left out."""
    items = document.sequence(node, what)
    if len(items) > _MAX_STEPS:
        document.fault(node, f"{what} has {len(items)} steps; at most {_MAX_STEPS} are read")
        return []
    built = [_step_from_node(document, item) for item in items]
    return [step for step in built if step is not None]


def _step_from_node(document: YamlDocument, node: yaml.Node) -> Transform | None:
    """Build one step written as ``Name`` or ``{Name: fields}``."""
    if isinstance(node, yaml.ScalarNode):
        name = str(node.value)
        name_node: yaml.Node = node
        fields_node: yaml.Node | None = None
    elif not isinstance(node, yaml.MappingNode):
        document.fault(node, "a step must be a name, or a name with its fields, not a list")
        return None
    else:
        entries = document.mapping(node, "a step")
        if len(entries) != 1:
            document.fault(node, f"a step is one name with its fields, got {len(entries)} names: {sorted(entries)}")
            return None
        ((name, place),) = entries.items()
        name_node, fields_node = place
    cls = REGISTRY.get(name)
    if cls is None:
        hint = near_matches(name, REGISTRY) or f"; known: {', '.join(sorted(REGISTRY))}"
        document.fault(name_node, f"unknown transform {name!r}{hint}; one of your own needs --import FILE.py")
        return None
    return _build(document, cls, name_node, fields_node)


def _build(
    document: YamlDocument, cls: type[Transform], name_node: yaml.Node, fields_node: yaml.Node | None
) -> Transform | None:
    before = len(document.faults)
    entries = document.mapping(fields_node, cls.__name__)
    fields: dict[str, Any] = {}
    for key, (_, value) in entries.items():
        known = len(document.faults)
        read = _field_value(document, cls, key, value)
        if len(document.faults) == known:
            fields[key] = read
    check_sensor_unit(document, cls, {key: node for key, (_, node) in entries.items()}, fields)
    for path, message in field_faults(cls, fields):
        if str(path[0]) in entries and str(path[0]) not in fields:
            continue  # not missing: it could not be read, and that was said
        place = ".".join(map(str, (cls.__name__, *path)))
        hint = sensor_hint(fields.get(str(path[0])))
        document.fault(_place(cls, entries, fields_node, name_node, path), f"{place}: {message}{hint}")
    if len(document.faults) > before:
        return None
    try:
        return cls(**fields)
    except ConfigError as error:  # rules that bind several fields
        document.fault(name_node, str(error))
        return None


def _field_value(document: YamlDocument, cls: type[Transform], key: str, node: yaml.Node) -> Any:
    """Read one field; fields that hold transforms are steps themselves."""
    declared = field_types(cls).get(key) if key in field_names(cls) else None  # type: ignore[arg-type]
    if declared is Transform:
        return _step_from_node(document, node)
    if declared == Sequence[Transform]:
        return steps_from_node(document, node, f"{cls.__name__}.{key}")
    return sensor_value(document, node, cls, key) if is_sensor_word(node, declared) else document.plain(node)


def _place(
    cls: type[Transform],
    entries: Mapping[str, tuple[yaml.Node, yaml.Node]],
    fields_node: yaml.Node | None,
    name_node: yaml.Node,
    path: tuple[int | str, ...],
) -> yaml.Node:
    """Point at the value where there is one, at an unknown field's name, else at the step."""
    if not path or str(path[0]) not in entries:
        return fields_node if fields_node is not None and fields_node.value else name_node
    key, value = entries[str(path[0])]
    return key if path[0] not in field_names(cls) else node_at(value, path[1:])  # type: ignore[arg-type]
