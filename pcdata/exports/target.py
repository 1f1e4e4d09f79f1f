"""What an export target is: options as fields, items as the units that are finished one by one, and a writer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

from pcdata.structures import DepthFrame, PointCloud

Samples = Iterator[tuple[str, DepthFrame | PointCloud]]  # ids and what was loaded, one at a time
Note = Callable[[str], None]  # tell the user what the loader would not


@dataclass(frozen=True)
class Item:
    """What is written in one go: samples, and the files or folders that they become, relative to the export.

    The last path is put into place last: where it exists, the item is finished.
    """

    ids: tuple[str, ...]
    paths: tuple[str, ...]


class CloudArray(NamedTuple):
    """Where a file of an export has its clouds, and what their columns are."""

    name: str
    channels: tuple[str, ...]  # as the model's contract calls them


@dataclass(frozen=True, kw_only=True)
class Target(ABC):
    """A layout that some official loader opens; the fields of a subclass are its options."""

    name: ClassVar[str]
    takes: ClassVar[Literal["clouds", "captures"]]
    layout: ClassVar[str]  # what is written, in words
    model: ClassVar[str]  # the contract in pcdata.models of what its loader feeds; samples are held to it
    left_to_loader: ClassVar[frozenset[str]] = frozenset()  # rules of the contract that the loader itself makes true

    @abstractmethod
    def items(self, ids: Sequence[str]) -> list[Item]:
        """Plan the export of these samples; reads side files such as class tables, no sample.

        Raises:
            ConfigError: an option is missing or does not fit the samples.
        """

    @abstractmethod
    def write(self, item: Item, samples: Samples, folder: Path, note: Note) -> None:
        """Write one item below ``folder``, from samples that come in the order of ``item.ids`` and are not kept.

        Raises:
            PcdataError: a sample is not what the loader needs; names the sample and what to do.
        """

    def finish(self, items: Sequence[Item], folder: Path, note: Note) -> None:
        """Write what goes over all items, such as lists of files; here nothing."""
        return

    @classmethod
    def cloud_arrays(cls, folder: Path, options: Mapping[str, Any]) -> dict[Path, CloudArray]:
        """Return the files of an export with these options that ``pcdata check`` reads; here none."""
        return {}

    def options(self) -> dict[str, Any]:
        """Return the options as JSON can hold them; of a mapping, the names in it."""
        return {field.name: _plain(getattr(self, field.name)) for field in fields(self)}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return sorted(map(str, value))
    return str(value) if isinstance(value, Path) else value
