"""Plain data, as JSON holds it, read as a parsed file is: a node is the value itself, and a fault has no line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pcdata.errors import ConfigError, first_lines
from pcdata.yaml_nodes import SensorChoice

_TEXT = {str}


class PlainDocument:
    """What :class:`pcdata.yaml_nodes.YamlDocument` is for text; faults say the name of the step and the field."""

    sensor: SensorChoice | None = None

    def __init__(self, data: Any, name: str) -> None:
        """Begin; ``name`` stands before every fault."""
        self.name = name
        self.root = data
        self.faults: list[Any] = []

    def fault(self, node: Any, message: str) -> None:
        """Note a fault."""
        self.faults.append(message)

    def raise_faults(self) -> None:
        """Raise one error with every fault, if there are any."""
        if self.faults:
            raise ConfigError(first_lines([f"{self.name}: {message}" for message in self.faults]))

    def mapping(self, node: Any, what: str) -> dict[str, tuple[Any, Any]]:
        """Read a mapping as key -> (key, value); None is an empty mapping."""
        if node is None:
            return {}
        if not isinstance(node, Mapping) or not _TEXT.issuperset(map(type, node)):
            self.fault(node, f"{what} must be a mapping of names to values, not {type(node).__name__} {node!r:.60}")
            return {}
        return dict(zip(node, node.items()))

    def sequence(self, node: Any, what: str) -> list[Any]:
        """Read a list; None is an empty list."""
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
        """Return the value."""
        return node

    def at(self, node: Any, path: Any) -> Any:
        """Return the node: it has no place that could be told."""
        return node
