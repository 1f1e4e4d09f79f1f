"""YAML with a memory of where every value stood, so that errors can say file:line:column."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import yaml

from pcdata.errors import ConfigError, PcdataError, first_lines
from pcdata.sensors import SensorProfile

_MAX_CHARACTERS = 1_000_000  # a configuration is written by hand
_MAX_NODES = 30_000  # 1,000 pairs of poses; PyYAML takes some 100 microseconds for each value
_MAX_FAULTS = 200  # the file is none of its kind then; finding every one can take a minute
_MAX_DEPTH = 50  # pipelines nest a few levels deep
_MAX_DIGITS = 1000  # no float has more than 309 before its point; Python refuses to convert 4,300
_LONGEST_NAME = 60  # characters of a name that a message repeats
_TEXT = {str}


class _Refused(yaml.MarkedYAMLError):
    """Valid YAML that no configuration needs and that costs without bound."""


class _Loader(yaml.SafeLoader):
    """Reads 5e-3 as a number, as YAML 1.2 and everybody else does; YAML 1.1 wants 5.0e-3.

    Refuses aliases, which let a small file expand without bound, tags, which put types on values they do not fit, and
    deep nesting, before any of it is built.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._nodes = self._depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node that is allowed."""
        event: yaml.Event = self.peek_event()  # type: ignore[no-untyped-call]
        if isinstance(event, yaml.AliasEvent):
            raise _refused(event, "YAML aliases (*name) are not allowed; write the value out")
        if (tag := getattr(event, "tag", None)) not in (None, "!"):
            raise _refused(event, f"YAML tags ({tag:.60}) are not allowed; write the plain value")
        self._nodes += 1
        if self._nodes > _MAX_NODES:
            raise _refused(event, f"holds more than {_MAX_NODES} values, as no file of this kind does")
        if self._depth >= _MAX_DEPTH:
            raise _refused(event, f"nested too deeply, more than {_MAX_DEPTH} levels")
        self._depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1


def _refused(event: yaml.Event, problem: str) -> _Refused:
    return _Refused(None, None, problem, event.start_mark)  # type: ignore[arg-type]


_Loader.yaml_implicit_resolvers = {**yaml.SafeLoader.yaml_implicit_resolvers}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$"), list("-+.0123456789")
)


class GivenMark(yaml.Mark):
    """The place of a value that does not stand in the file: where it was given instead."""

    def __init__(self, where: str) -> None:
        super().__init__(where, 0, -1, -1, None, 0)


def compose(text: str) -> yaml.Node:
    """Return the node of a value written as YAML; nothing is a null.

    Raises:
        yaml.YAMLError: it is no YAML, or more than a configuration needs.
    """
    node: yaml.Node | None = yaml.compose(text, _Loader)
    return yaml.ScalarNode("tag:yaml.org,2002:null", "") if node is None else node


def parse_yaml(text: str) -> Any:
    """Return the plain data of a YAML text of any origin.

    Raises:
        ValueError: no YAML, or more than any file of plain facts needs: aliases, tags, deep nesting, many values.
    """
    try:
        loader = _Loader(text)  # which refuses characters that no text holds
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except (yaml.YAMLError, RecursionError, AttributeError, TypeError, OverflowError, LookupError) as error:
        raise ValueError(str(error)[:300]) from error


class _Dumper(yaml.SafeDumper):
    """Writes a value used twice out twice: aliases are refused when read."""

    def ignore_aliases(self, data: Any) -> bool:
        """Never write an alias."""
        return True


def yaml_text(data: Any) -> str:
    """Write plain data as YAML that :class:`YamlDocument` reads back.

    Raises:
        ConfigError: something that is not plain data.
    """
    try:
        return yaml.dump(data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=110)
    except yaml.YAMLError as error:
        raise ConfigError(f"a configuration holds plain data only: {error}") from error


class Document:
    """Plain data, as JSON holds it, read node by node: a node is the value itself, and a fault has no line.

    :class:`YamlDocument` is the same for text.
    """

    # What the word "sensor" stands for, where the data name one: it, and the depth in metres of its figures.
    sensor: tuple[SensorProfile, float] | None = None

    def __init__(self, data: Any, name: str) -> None:
        """Begin; ``name`` stands before every fault."""
        self.name = name
        self.root: Any = data
        self.faults: list[Any] = []

    def fault(self, node: Any, message: str) -> None:
        """Note a fault at a node."""
        self.faults.append(message)

    def raise_faults(self) -> None:
        """Raise one error with every fault, if there are any."""
        if self.faults:
            raise ConfigError(first_lines([f"{self.name}: {message}" for message in self.faults]))

    def mapping(self, node: Any, what: str) -> dict[str, tuple[Any, Any]]:
        """Read a mapping as key -> (node of the key, node of the value); None is an empty one; faults are noted."""
        if node is None:
            return {}
        if not isinstance(node, Mapping) or not _TEXT.issuperset(map(type, node)):
            self.fault(node, f"{what} must be a mapping of names to values, not {type(node).__name__} {node!r:.60}")
            return {}
        return dict(zip(node, node.items()))

    def sequence(self, node: Any, what: str) -> list[Any]:
        """Read a list; None is an empty one; faults are noted."""
        if node is None:
            return []
        if not isinstance(node, (list, tuple)):
            self.fault(node, f"{what} must be a list, not {type(node).__name__} {node!r:.60}")
            return []
        return list(node)

    def word(self, node: Any) -> str | None:
        """Return a single value as text; None = a mapping or a list."""
        return None if isinstance(node, (Mapping, list, tuple)) else str(node)

    def is_mapping(self, node: Any) -> bool:
        """Whether the node is a mapping."""
        return isinstance(node, Mapping)

    def plain(self, node: Any) -> Any:
        """Return the node's value."""
        return node

    def at(self, node: Any, path: Sequence[int | str]) -> Any:
        """Follow keys and positions as far as they lead to a place that can be told: nowhere."""
        return node


class YamlDocument(Document):
    """One parsed file and the faults found in it so far; all are reported at once."""

    def __init__(self, text: str, name: str, *, error: type[PcdataError] = ConfigError) -> None:
        """Parse the text; ``name`` stands before every place, ``error`` is what a fault raises."""
        super().__init__(None, name)
        self.error = error
        if len(text) > _MAX_CHARACTERS:
            raise error(f"{name}: {len(text)} characters are no file of this kind; the limit is {_MAX_CHARACTERS}")
        try:
            self.root = yaml.compose(text, _Loader)
        except _Refused as fault:
            self.fault_at(fault.problem_mark, str(fault.problem))
            self.raise_faults()
        except yaml.MarkedYAMLError as fault:
            way = "; indent with spaces, a tab is none" if "'\\t'" in str(fault.problem) else ""
            self.fault_at(fault.problem_mark, f"not valid YAML: {fault.problem:.200}{way}")
            self.raise_faults()
        except yaml.reader.ReaderError as fault:
            raise error(
                f"{name}: not valid YAML: character {fault.position} is number {fault.character}, which no text has; "
                "is it another file, or damaged?"
            ) from fault
        except yaml.YAMLError as fault:
            raise error(f"{name}: not valid YAML: {fault}") from fault
        except RecursionError as fault:
            raise error(f"{name}: cannot be read: nested too deeply") from fault
        except (ValueError, IndexError, OverflowError) as fault:  # escapes and versions that are no numbers
            raise error(f"{name}: not valid YAML: {fault!s:.200}") from fault
        if self.root is None or _is_null(self.root):
            raise error(f"{name}: is empty: it holds no value; was it saved, or is it the wrong file?")

    def fault(self, node: yaml.Node | None, message: str) -> None:
        """Note a fault at a node."""
        self.fault_at(node.start_mark if node is not None else None, message)

    def fault_at(self, mark: yaml.Mark | None, message: str) -> None:
        """Note a fault at a place in the file; one too many raises them all."""
        self.faults.append((mark, message))
        if len(self.faults) > _MAX_FAULTS:
            self.raise_faults()

    def raise_faults(self) -> None:
        """Raise one error with every fault in file order, if there are any."""
        if not self.faults:
            return
        ordered = sorted(self.faults, key=lambda fault: (fault[0].line, fault[0].column) if fault[0] else (-1, -1))
        raise self.error(first_lines([f"{self._place(mark)}: {message}" for mark, message in ordered]))

    def _place(self, mark: yaml.Mark | None) -> str:
        if isinstance(mark, GivenMark):
            return str(mark.name)
        return f"{self.name}:{mark.line + 1}:{mark.column + 1}" if mark else self.name

    def mapping(self, node: yaml.Node | None, what: str) -> dict[str, tuple[yaml.Node, yaml.Node]]:
        """Read a mapping as key -> (key node, value node); an empty node is an empty mapping; faults are noted."""
        if node is None or _is_null(node):
            return {}
        if not isinstance(node, yaml.MappingNode):
            self.fault(node, f"{what} must be a mapping of names to values, not {_kind(node)}")
            return {}
        found: dict[str, tuple[yaml.Node, yaml.Node]] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                self.fault(key, f"{what}: a name must be a single word, not {_kind(key)}")
                continue
            name = str(key.value)
            if name in found:
                self.fault(key, f"{what}: {name[:_LONGEST_NAME]!r} is given twice")
            found[name] = (key, value)
        return found

    def sequence(self, node: yaml.Node | None, what: str) -> list[yaml.Node]:
        """Read a list; an empty node is an empty list; faults are noted."""
        if node is None or _is_null(node):
            return []
        if not isinstance(node, yaml.SequenceNode):
            self.fault(node, f"{what} must be a list, each entry starting with '- ', not {_kind(node)}")
            return []
        return list(node.value)

    def word(self, node: yaml.Node) -> str | None:
        """Return a single value as text; None = a mapping or a list."""
        return str(node.value) if isinstance(node, yaml.ScalarNode) else None

    def is_mapping(self, node: yaml.Node | None) -> bool:
        """Whether the node is a mapping."""
        return isinstance(node, yaml.MappingNode)

    def at(self, node: yaml.Node, path: Sequence[int | str]) -> yaml.Node:
        """Follow keys and positions as far as they lead."""
        for part in path:
            if isinstance(node, yaml.MappingNode):
                children = {str(key.value): value for key, value in node.value}
                if str(part) not in children:
                    break
                node = children[str(part)]
            elif isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
                node = node.value[part]
            else:
                break
        return node

    def plain(self, node: yaml.Node) -> Any:
        """Return the node's value as plain Python data; duplicate keys are noted as faults."""
        before = len(self.faults)
        for part in _parts(node):
            if isinstance(part, yaml.MappingNode):
                self.mapping(part, "mapping")
            elif isinstance(part, yaml.ScalarNode) and part.tag in _NUMBERS:
                if len(part.value) > _MAX_DIGITS:
                    self.fault(part, f"a number of {len(part.value)} digits is none that can be meant")
                elif part.tag in _NUMBERS[:2] and ":" in part.value:  # YAML 1.1 counts 1:30 in sixties
                    self.fault(part, f"{part.value!r} would be read as a time in sixties; write a plain number")
        if len(self.faults) > before:
            return None
        try:
            return _Loader("").construct_object(node, deep=True)
        except yaml.MarkedYAMLError as error:
            self.fault_at(error.problem_mark, f"cannot read this value: {error.problem:.200}")
        except Exception as error:  # PyYAML trusts that words fit their types
            self.fault(node, f"cannot read this value: {str(error) or type(error).__name__:.200}")
        return None


def _is_null(node: yaml.Node) -> bool:
    return node.tag == "tag:yaml.org,2002:null"


def _kind(node: yaml.Node) -> str:
    if isinstance(node, yaml.ScalarNode):
        return f"the single value {node.value[:_LONGEST_NAME]!r}"
    return "a list" if isinstance(node, yaml.SequenceNode) else "a mapping"


_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float", "tag:yaml.org,2002:timestamp")


def _parts(node: yaml.Node) -> Iterator[yaml.Node]:
    """Return a node and all within it, names of mappings too."""
    yield node
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            yield from _parts(key)
            yield from _parts(value)
    elif isinstance(node, yaml.SequenceNode):
        for item in node.value:
            yield from _parts(item)
