"""What a history says was decided, found again for the steps of a chain: what :meth:`Compose.replay` repeats.

An entry of a history has the params of its step (a matrix, a factor, a plane), the key of its stream where it drew, and
a number that tells which rows it decided about where that depends on the rows: nothing of the size of the cloud.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from pcdata.errors import ReplayError, first_lines
from pcdata.rng import Streams
from pcdata.structures.kinds import FIELDS

Entry = Mapping[str, Any]  # one step in the history of one cloud

OF_VIEW = "of_view"  # key of an entry that is known of one view alone
PER_VIEW = "per_view"  # key of what differs between the views that were merged
PER_ROW = ("index", "ptr", "per_point", *FIELDS)  # params of rows, not of clouds
TOLD_ROWS = "rows"  # param (B,) int64: what tells which rows were decided about, where the step has found it out
LISTS = ("cuts", "joins", "areas")  # params with a row for each thing found, which begins with the number of its cloud
DERIVED = (
    "corners",
    "rms",
    "place",
    "place_ptr",
)  # params that follow from others and the data: a history does not tell them
_LEAVE_OUT = "leave it out of the chain that is replayed, or run it on these data anew"


@dataclass(frozen=True)
class Decision:
    """What one step decided about one cloud."""

    entry: Entry
    place: int  # of the entry in its history
    within: Sequence[Decision] = ()  # of the steps within it that ran

    def of_view(self, view: int | None) -> Decision:
        """Return what was decided about one of the views that were merged; None = they were not."""
        if view is None:
            return self
        if OF_VIEW in self.entry and self.entry[OF_VIEW] != view:
            raise ReplayError(
                f"the history of a merged cloud tells step {self.entry['step']} of view {self.entry[OF_VIEW]} alone, "
                "since the views went different ways; replay each view by the history that it had before MergeViews"
            )
        parts = {name: _part(self.entry[name], view) for name in ("params", "stream", "rows") if name in self.entry}
        return Decision({**self.entry, **parts}, self.place, [one.of_view(view) for one in self.within])


def _part(value: Any, view: int) -> Any:
    if not (isinstance(value, Mapping) and set(value) == {PER_VIEW}):
        return value
    parts = value[PER_VIEW]
    if not (isinstance(parts, Sequence) and view < len(parts)):
        raise ReplayError(f"the history has nothing of view {view}: {parts!r:.100}")
    return parts[view]


class Decisions:
    """What one step decided about B clouds."""

    def __init__(self, step: str, of_clouds: Sequence[Decision]) -> None:
        self.step = step
        self.of_clouds = of_clouds

    def __len__(self) -> int:
        return len(self.of_clouds)

    def values(self, name: str, like: Tensor | None = None) -> Tensor:
        """Return a param of all clouds, (B, ...); of the dtype, device and shape of ``like``, else float64.

        Raises:
            ReplayError: the history has it not, or something else than such numbers.
        """
        told = [self.told(b).get(name) for b in range(len(self))]
        dtype, device = (torch.float64, torch.device("cpu")) if like is None else (like.dtype, like.device)
        try:
            values = torch.tensor(told, dtype=dtype, device=device)
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise ReplayError(self._wrong(name, told)) from error
        if like is not None and values.shape[1:] != like.shape[1:]:
            raise ReplayError(self._wrong(name, told))
        if values.is_floating_point() and not bool(torch.isfinite(values).all()):
            raise ReplayError(self._wrong(name, told))
        return values

    def _wrong(self, name: str, told: Any) -> str:
        return (
            f"{self.step}: the history does not tell its {name}, got {told!r:.200}; give the history of a cloud that "
            "this step has changed"
        )

    def has(self, name: str) -> bool:
        """Whether the history tells a param."""
        return all(name in self.told(b) for b in range(len(self)))

    def told(self, b: int) -> Mapping[str, Any]:
        """Return all params of one cloud as the history has them."""
        params = self.of_clouds[b].entry.get("params")
        if not isinstance(params, Mapping):
            raise ReplayError(f"{self.step}: the history tells no params, got {params!r:.100}")
        return params

    def streams(self) -> Streams:
        """Return streams that give each cloud the draws that it had.

        Raises:
            ReplayError: the history does not tell them.
        """
        keys = [one.entry.get("stream") for one in self.of_clouds]
        if not all(isinstance(key, int) and -(2**63) <= key < 2**63 for key in keys):
            raise ReplayError(
                f"{self.step}: is random, and the history does not tell its stream, got {keys!r:.100}; run the chain "
                "again to get a history that does"
            )
        return Streams(np.array(keys, dtype=np.int64))

    def check_rows(self, rows: Sequence[int] | None) -> None:
        """Require that the rows decided about now are those decided about then.

        Raises:
            ReplayError: they are others.
        """
        if rows is None:
            return
        for b, (now, decision) in enumerate(zip(rows, self.of_clouds, strict=True)):
            then = decision.entry.get("rows")
            if now == then:
                continue
            if then is None:
                raise ReplayError(f"{self.step}: the history does not tell which rows it chose; run the chain again")
            raise ReplayError(
                f"{self.step}: what it decided about cloud {b} was about its rows, and these data have other ones: "
                f"it cannot be carried over; give data with the same points, pixel for pixel, or {_LEAVE_OUT}"
            )

    def check_place(self, frame: str | None, unit: str | None) -> None:
        """Require that the coordinates are now in the frame and the unit that they were in then.

        Raises:
            ReplayError: they are in others.
        """
        for b, decision in enumerate(self.of_clouds):
            then = decision.entry.get("frame"), decision.entry.get("unit")
            if then != (frame, unit):
                raise ReplayError(
                    f"{self.step}: cloud {b} was in {then[0]!r} [{then[1]}] after it and is in {frame!r} [{unit}] now, "
                    "where what was decided means something else; bring the data into that frame and unit first"
                )


# -- finding the steps of a chain in a history -------------------------------------------------------------------------


class Step(Protocol):
    """What finds its own entry in a history."""

    def find_decision(self, entries: Sequence[Entry], stop: int) -> tuple[Decision, int] | None:
        """Return what this step decided, if entry ``stop - 1`` is its, and where its first entry is."""
        ...


def histories_of(where: str, history: Any) -> tuple[list[Sequence[Entry]], bool]:
    """Return the history of each cloud, and whether one was given for all clouds.

    Raises:
        ReplayError: it is neither a history nor a sequence of histories.
    """

    def is_list(value: Any) -> bool:
        return isinstance(value, Sequence) and not isinstance(value, str | bytes)

    def is_one(value: Any) -> bool:
        return is_list(value) and all(isinstance(entry, Mapping) for entry in value)

    if is_list(history) and len(history) and is_one(history):
        return [history], True
    if is_list(history) and len(history) and all(map(is_one, history)):
        return list(history), False
    raise ReplayError(
        f"{where}: takes the history of a cloud, which is a list of steps, or one for each cloud, as cloud.history is, "
        f"or that of a capture, capture.provenance['history']; got {history!r:.100}"
    )


def find_decisions(where: str, steps: Sequence[Step], entries: Sequence[Entry]) -> list[Decision]:
    """Return what each step decided, by a history that has them in this order.

    Where they follow one another in several places, it is the last; else other steps may lie between them.

    Raises:
        ReplayError: they are not there, or in several ways with others between them.
    """
    for stop in range(len(entries), -1, -1):
        found = in_a_row(steps, entries, stop)
        if found is not None:
            return found[0]
    latest: list[Decision] = []
    stop = len(entries)
    for step in reversed(steps):
        while stop > 0 and (found_one := step.find_decision(entries, stop)) is None:
            stop -= 1
        if stop <= 0:
            _refuse(where, steps, entries, len(steps) - len(latest))
        assert found_one is not None
        latest.insert(0, found_one[0])
        stop = found_one[1]
    first = 0
    for step, last in zip(steps, latest):
        for stop in range(first + 1, last.place + 2):
            found_one = step.find_decision(entries, stop)
            if found_one is not None and found_one[1] >= first:
                break
        if found_one is None or found_one[0].place != last.place:
            raise ReplayError(
                f"{where}: the history has {last.entry['step']} in several places, with other steps between those of "
                "the chain, so it is open which is meant; give the part of the history that is"
            )
        first = last.place + 1
    return latest


def in_a_row(steps: Sequence[Step], entries: Sequence[Entry], stop: int) -> tuple[list[Decision], int] | None:
    """Return what each step decided, and where the first entry is, if their entries end one after another at stop."""
    decisions: list[Decision] = []
    for step in reversed(steps):
        found = step.find_decision(entries, stop) if stop > 0 else None
        if found is None:
            return None
        decision, stop = found
        decisions.insert(0, decision)
    return decisions, stop


def _refuse(where: str, steps: Sequence[Step], entries: Sequence[Entry], number: int) -> None:
    told = [f"{entry.get('step')}(version {entry.get('version')}): {entry.get('fields')}" for entry in entries]
    raise ReplayError(
        f"{where}: the history does not have the steps of the chain in their order: it lacks step {number}, "
        f"{steps[number - 1]!r}, where it should be. It has\n{first_lines(told) or 'no steps'}\n"
        "Give the chain that made it, or some of its steps in their order"
    )
