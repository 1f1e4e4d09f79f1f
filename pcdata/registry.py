"""Named things of one kind, of which anybody may add some: one shape for checks, stores, collates, exports, ...

What hangs in a registry has its line in ``--help`` and in the docs, and its laws are tested, because all of these are
made from the registry. A file given with ``--import`` may add to every one of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeVar

from pcdata.errors import ConfigError, near_matches

Member = TypeVar("Member")


class Registry(dict[str, Member]):
    """Members by name, in the order in which they were added."""

    def __init__(self, noun: str) -> None:
        super().__init__()
        self.noun = noun  # of one member, as messages call it: "check"
        _ALL.append(self)

    def add(self, name: str, member: Member) -> None:
        """Add a member; the same definition may be added again.

        Raises:
            ConfigError: the name is no text, or another member has it.
        """
        if not isinstance(name, str) or not name:
            raise ConfigError(f"a {self.noun} must have a text as its name, got {name!r:.100}")
        if name in self and _home(self[name]) != _home(member):
            raise ConfigError(f"a {self.noun} called {name} is registered already; choose another name")
        self[name] = member

    def named(self, where: str, name: str) -> Member:
        """Return a member.

        Raises:
            ConfigError: there is none of this name; says which there are.
        """
        if name not in self:
            raise ConfigError(
                f"{where}: no {self.noun} {name!r:.100}{near_matches(str(name), self)}; there are {', '.join(self)}"
            )
        return self[name]

    def names_from(self, module: str) -> tuple[str, ...]:
        """Return the names of the members that a module defines."""
        return tuple(name for name, member in self.items() if getattr(member, "__module__", None) == module)


def registries() -> Iterator[Registry[Any]]:
    """Yield every registry."""
    return iter(_ALL)


def _home(member: object) -> tuple[object, ...]:
    names = tuple(getattr(member, name, None) for name in ("__module__", "__qualname__"))
    return names if all(names) else (member,)


_ALL: list[Registry[Any]] = []
