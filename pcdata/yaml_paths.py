"""Single values of a YAML document set from outside, by their path: ``cloud.FarthestPointSample.num_points=2048``.

A part of a path is a name in a mapping, or in a list the name or the place (from 0) of a step. What is set is a value
as YAML writes it; faults in it are told with the path instead of a line.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import yaml

from pcdata.errors import ConfigError, near_matches
from pcdata.yaml_nodes import GivenMark, YamlDocument, compose

_NULL, _MAP, _TEXT = "tag:yaml.org,2002:null", "tag:yaml.org,2002:map", "tag:yaml.org,2002:str"


def set_value(document: YamlDocument, path: str, text: str) -> None:
    """Set one value of a document that is not read yet.

    Raises:
        ConfigError: there is no such place, or the text is no YAML.
    """
    where = f"--set {path}"
    parts = path.split(".")
    if len(parts) < 2 or not all(parts):
        raise ConfigError(f"{where}={text}: needs a path such as output.format or cloud.CropWorkspace.bounds")
    try:
        value = compose(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"{where}: {text!r:.100} is no value in YAML: {str(error).splitlines()[0]}") from error
    mark = GivenMark(where)
    _mark(value, mark)
    node = document.root
    for number, part in enumerate(parts[:-1]):
        node = _below(node, part, where, parts[:number], mark)
    _put(node, parts[-1], value, where, parts[:-1], mark)


def _below(node: Any, part: str, where: str, before: Sequence[str], mark: Any) -> Any:
    """Return the node that a part of a path leads to; a section that is not there yet is begun."""
    if isinstance(node, yaml.SequenceNode):
        return _step(node, part, where, before, mark)
    if not isinstance(node, yaml.MappingNode):
        raise ConfigError(f"{where}: {_named(before)} is a single value, which has no {part!r}")
    for place, (key, value) in enumerate(node.value):
        if isinstance(key, yaml.ScalarNode) and key.value == part:
            if isinstance(value, yaml.ScalarNode) and value.tag == _NULL:
                value = _mapping(mark)
                node.value[place] = (key, value)
            return value
    if before:
        names = [str(key.value) for key, _ in node.value]
        raise ConfigError(f"{where}: {_named(before)} has no {part!r}{_hint(part, names)}")
    node.value.append((_text(part, mark), _mapping(mark)))
    return node.value[-1][1]


def _step(node: yaml.SequenceNode, part: str, where: str, before: Sequence[str], mark: Any) -> Any:
    """Return the fields of a step in a list, found by its name or place."""
    if part.isdecimal():
        if int(part) >= len(node.value):
            raise ConfigError(f"{where}: {_named(before)} has {len(node.value)} entries, counted from 0")
        return node.value[int(part)]
    names = [_name(item) for item in node.value]
    if part not in names:
        raise ConfigError(f"{where}: {_named(before)} has no step {part!r}{_hint(part, names)}")
    place = names.index(part)
    if names.count(part) > 1:
        which = f"{_named(before)}.{place}.{part}"
        raise ConfigError(f"{where}: {_named(before)} has {part!r} several times; say which by its place: {which}")
    item = node.value[place]
    if isinstance(item, yaml.ScalarNode):  # a step without fields, written as its name alone
        node.value[place] = item = yaml.MappingNode(_MAP, [(item, _mapping(mark))], item.start_mark, item.end_mark)
    return _below(item, part, where, before, mark)


def _put(node: Any, part: str, value: Any, where: str, before: Sequence[str], mark: Any) -> None:
    if isinstance(node, yaml.SequenceNode) and part.isdecimal() and int(part) < len(node.value):
        node.value[int(part)] = value
    elif isinstance(node, yaml.MappingNode):
        kept = [(key, old) for key, old in node.value if getattr(key, "value", None) != part]
        node.value = [*kept, (_text(part, mark), value)]
    else:
        kind = "a list" if isinstance(node, yaml.SequenceNode) else "a single value"
        raise ConfigError(f"{where}: {_named(before)} is {kind}, which has no {part!r}")


def _name(item: Any) -> str:
    key = item.value[0][0] if isinstance(item, yaml.MappingNode) and len(item.value) == 1 else item
    return str(key.value) if isinstance(key, yaml.ScalarNode) else ""


def _hint(part: str, names: Sequence[str]) -> str:
    return near_matches(part, names) or f"; it has {', '.join(filter(None, names)) or 'nothing'}"


def _named(before: Sequence[str]) -> str:
    return ".".join(before) or "the configuration"


def _mapping(mark: Any) -> yaml.MappingNode:
    return yaml.MappingNode(_MAP, [], mark, mark)


def _text(text: str, mark: Any) -> yaml.ScalarNode:
    return yaml.ScalarNode(_TEXT, text, mark, mark)


def _mark(node: Any, mark: Any) -> None:
    """Let all of a value say where it was set."""
    node.start_mark = node.end_mark = mark
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            _mark(key, mark)
            _mark(value, mark)
    elif isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _mark(item, mark)
