"""What an export target is: options as fields, items as the units that are finished one by one, and a writer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

from numpy.typing import NDArray

from pcdata.structures import DepthFrame, Episode, PointCloud

Samples = Iterator[tuple[str, DepthFrame | PointCloud]]  # ids and what was loaded, one at a time
Note = Callable[[str], None]  # tell the user what the loader would not


@dataclass(frozen=True)
class Item:
    """What is written in one go: samples, and the files or folders that they become, relative to the export.

    The last path is put into place last: where it exists, the item is finished.
    """

    ids: tuple[str, ...]
    paths: tuple[str, ...]
    episodes: tuple[Episode, ...] = ()  # over the ids, of a target that is of episodes
    unwritten: Mapping[str, str] = field(default_factory=dict)  # ids that are read for others' sake alone -> why


class CloudArray(NamedTuple):
    """Where a file of an export has its clouds, and what their columns are."""

    name: str
    channels: tuple[str, ...]  # as the model's contract calls them
    category: str = ""  # the array with the number of every cloud's class, where the model takes it


@dataclass(frozen=True, kw_only=True)
class Target(ABC):
    """A layout that some official loader opens; the fields of a subclass are its options."""

    name: ClassVar[str]
    takes: ClassVar[Literal["clouds", "captures"]]
    layout: ClassVar[str]  # what is written, in words
    model: ClassVar[str]  # the contract in pcdata.models of what its loader feeds; samples are held to it
    left_to_loader: ClassVar[frozenset[str]] = frozenset()  # rules of the contract that the loader itself makes true
    of_episodes: ClassVar[bool] = False  # its samples are steps: those of one episode share their random draws
    # Further contracts whose loaders read the same files -> what those make true besides left_to_loader.
    also: ClassVar[Mapping[str, frozenset[str]]] = {}
    any_crop: ClassVar[bool] = False  # its clouds need not be cropped as the contract says
    image_size: ClassVar[tuple[int, int] | None] = None  # (height, width) that the loader asserts; None = any

    @classmethod
    def models(cls) -> tuple[str, ...]:
        """Return the contracts whose presets' data it exports."""
        return (cls.model, *cls.also)

    @classmethod
    def left_for(cls, model: str) -> frozenset[str]:
        """Return the rules of a contract that its loader of these files makes true; none where it has none."""
        return cls.left_to_loader | cls.also.get(model, frozenset()) if model in cls.models() else frozenset()

    @classmethod
    def example(cls, ids: Sequence[str]) -> dict[str, Any]:
        """Return the options that must be given for these samples, such as somebody could give; here none."""
        return {}

    @property
    def robot_stays(self) -> bool:
        """Whether states and actions are given beside the clouds, so that no random step may move the clouds alone."""
        return False

    def plan(self, ids: Sequence[str], episodes: Sequence[Episode], left_out: Collection[str]) -> list[Item]:
        """Plan the export of samples of a source without those that do not fit; see :meth:`items`.

        Args:
            ids: all samples of the source.
            episodes: those that the source has, over the ids.
            left_out: what does not fit. A target whose samples stand or fall together leaves out all of such a group.
        """
        return self.items([sample_id for sample_id in ids if sample_id not in left_out])

    @abstractmethod
    def items(self, ids: Sequence[str]) -> list[Item]:
        """Plan the export of these samples; reads side files such as class tables, no sample.

        Raises:
            ConfigError: an option is missing or does not fit the samples.
        """

    def examine(self, item: Item, sample_id: str, data: DepthFrame | PointCloud, seen: dict[str, Any]) -> Any:
        """Require what the files need of a sample, alone and beside those before it; return what :meth:`write` writes.

        Args:
            item: what it is written with.
            sample_id: its id.
            data: what was loaded.
            seen: what is remembered from one sample of the item to the next, empty at first.

        Raises:
            PcdataError: the sample is not what the loader needs; names it and what to do.
        """
        return None

    @abstractmethod
    def write(self, item: Item, samples: Samples, folder: Path, note: Note) -> None:
        """Write one item below ``folder``, from samples that come in the order of ``item.ids`` and are not kept.

        Every sample is examined first.
        """

    def finish(self, items: Sequence[Item], folder: Path, note: Note) -> None:
        """Write what goes over all items, such as lists of files; here nothing."""
        return

    @classmethod
    def cloud_arrays(cls, folder: Path, options: Mapping[str, Any]) -> dict[Path, CloudArray]:
        """Return the files of an export with these options whose arrays are clouds; here none."""
        return {}

    @classmethod
    def cloud_fields(cls, folder: Path, names: Sequence[str]) -> Iterator[tuple[str, dict[str, NDArray[Any]]]]:
        """Read the samples in these files of an export whose clouds are no arrays of one file.

        They are points, colors and normals, and of images depth (H, W) in metres and image (H, W, 3).

        Raises:
            OSError, ValueError: a file cannot be read.
        """
        return iter(())

    def with_splits(self, part_of: Mapping[str, str]) -> Target:
        """Return the target with the splits of a dataset, by sample or episode, where its options name none.

        Here nothing is split.
        """
        return self

    def options(self) -> dict[str, Any]:
        """Return the options as JSON can hold them; of a mapping, the names in it."""
        return {field.name: _plain(getattr(self, field.name)) for field in fields(self)}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return sorted(map(str, value))
    return str(value) if isinstance(value, Path) else value
