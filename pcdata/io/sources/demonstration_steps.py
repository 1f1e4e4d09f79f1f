"""Episodes of demonstrations, and what is read of one step of an open file: rows of arrays, and images among them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CaptureError
from pcdata.files.sample_names import name_some
from pcdata.io.arrays.hdf5_arrays import checked_dataset, hard_linked
from pcdata.io.sources.stated_kinds import KindAndFrame

Shapes = Mapping[str, tuple[int, ...]]  # of arrays, by their paths


@dataclass(frozen=True)
class Stream:
    """Arrays of an episode that are one signal, their columns side by side.

    Args:
        arrays: their paths within the episode's group.
        kind: what they are and in which frame, as the format says; None = it says nothing.
    """

    arrays: tuple[str, ...]
    kind: KindAndFrame | None = None


@dataclass(frozen=True)
class Demonstration:
    """One episode.

    Args:
        group: its path in the file.
        length: its steps that are read.
        attributes: JSON-able facts.
        texts: signals of kind text, the same in every step.
        seconds: between two steps; None = not known.
    """

    group: str
    length: int
    attributes: Mapping[str, Any] = field(default_factory=dict)
    texts: Mapping[str, str] = field(default_factory=dict)
    seconds: float | None = None


@dataclass(frozen=True)
class Steps:
    """One step of an episode of an open file."""

    where: str
    group: Any
    step: int
    file_bytes: int
    demonstration: Demonstration

    @property
    def seconds(self) -> float | None:
        """Seconds between two steps."""
        return self.demonstration.seconds

    def row(self, name: str) -> NDArray[Any]:
        """Return the row of this step of an array.

        Raises:
            CaptureError: there is none.
        """
        array = checked_dataset(self.group, name, self.file_bytes)
        if not array.shape or array.shape[0] <= self.step:
            raise CaptureError(f"{self.where}/{name}: has shape {array.shape}, but no row of step {self.step}")
        if array.dtype.kind not in "biuf":
            raise CaptureError(f"{self.where}/{name}: must hold numbers, got {array.dtype}")
        return np.asarray(array[self.step])

    def has(self, name: str) -> bool:
        """Whether the episode has such an array."""
        return hard_linked(self.group, name) is not None


def plane_of(steps: Steps, name: str) -> NDArray[Any]:  # (H, W)
    """Read the image of one channel of a step, whose channel may be an axis of its own.

    Raises:
        CaptureError: it has another shape.
    """
    image = steps.row(name)
    if image.ndim == 3 and image.shape[-1] == 1:
        image = image[..., 0]
    if image.ndim != 2 or not image.size:
        raise CaptureError(f"{steps.where}/{name}: an image of one channel is (steps, H, W, 1), got {image.shape} each")
    return image


def color_of(steps: Steps, name: str) -> NDArray[Any]:  # (H, W, 3) uint8
    """Read the color image of a step; a fourth channel, which is opacity, is dropped.

    Raises:
        CaptureError: it has another shape or dtype.
    """
    image = steps.row(name)
    if image.ndim != 3 or image.shape[-1] not in (3, 4) or image.dtype != np.uint8:
        raise CaptureError(
            f"{steps.where}/{name}: a color image is (steps, H, W, 3) uint8, got {image.dtype} of {image.shape} each"
        )
    return np.ascontiguousarray(image[..., :3])


def check_lengths(where: str, arrays: Shapes) -> int:
    """Return the number of steps that arrays of one episode have.

    Raises:
        CaptureError: they have different ones.
    """
    lengths = {path: (*shape, 0)[0] for path, shape in arrays.items()}
    if len({*lengths.values()}) > 1:
        told = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise CaptureError(f"{where}: its arrays have different numbers of steps: {told}; was the file cut short?")
    return next(iter(lengths.values()))


def same_cameras(where: str, first: Sequence[str], names: Sequence[str], episode: str) -> None:
    """Require an episode to have the cameras of the first.

    Raises:
        CaptureError: one is missing, or there is another.
    """
    if list(first) != list(names):
        raise CaptureError(
            f"{where}: {episode} has depth of {name_some(names) or 'no camera'}, the first episode of "
            f"{name_some(first)}; name the cameras that all have, one at a time (--camera NAME)"
        )


def without_frame(
    streams: Mapping[str, Stream], stated: Mapping[str, Any] | None
) -> tuple[dict[str, Stream], list[str]]:
    """Return the signals of a capture that does not know the frame they are in, and what is said of the others."""
    lost = [name for name, one in streams.items() if one.kind and one.kind[1] and name not in (stated or {})]
    told = f"signals {name_some(lost)}: where the camera is in their frame is not known; state the poses by calibration"
    return {name: one for name, one in streams.items() if name not in lost}, [told] if lost else []


def seconds_of_rate(settings: Any) -> float | None:
    """Return the seconds between two steps by the ``control_freq`` of a simulator's settings; None = not stated."""
    rate = settings.get("control_freq") if isinstance(settings, dict) else None
    return 1 / rate if isinstance(rate, (int, float)) and not isinstance(rate, bool) and 1e-6 < rate < 1e6 else None
