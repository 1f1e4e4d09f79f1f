"""What a step did, as entries of the histories of clouds that are made when somebody reads them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from pcdata.transforms.decisions import DERIVED, LISTS, PER_ROW, TOLD_ROWS

_UNTOLD = frozenset((*PER_ROW, *LISTS, *DERIVED, TOLD_ROWS))

Values = NDArray[Any] | Tensor  # of params: on another device they are read when they are asked for


class NotedSteps:
    """What a step did to each cloud of a batch, or to a capture, as entries of histories that are made when read."""

    __slots__ = ("_after", "_before", "_drawn", "_note", "_params", "_rows")

    def __init__(
        self,
        note: dict[str, Any],
        params: dict[str, Values],  # (B, ...) each
        before: list[int] | None = None,  # points of each cloud; None = other clouds
        after: list[int] | None = None,  # None = a capture
        drawn: NDArray[np.int64] | None = None,  # the stream of each cloud; None = the step is not random
        rows: Sequence[int] | None = None,  # a number that tells the rows of each
    ) -> None:
        self._note, self._params, self._drawn, self._rows = note, params, drawn, rows
        self._before, self._after = before, after

    def __len__(self) -> int:
        return 1 if self._after is None else len(self._after)

    def __getitem__(self, clouds: slice) -> NotedSteps:
        params = {name: value[clouds] for name, value in self._params.items()}
        lists = (self._before, self._after, self._drawn, self._rows)
        return NotedSteps(self._note, params, *(None if one is None else one[clouds] for one in lists))  # type: ignore[arg-type]

    def __reduce__(self) -> tuple[Any, ...]:
        params = {name: np.asarray(values.tolist()) for name, values in self._params.items()}
        return NotedSteps, (self._note, params, self._before, self._after, self._drawn, self._rows)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        listed = {name: value.tolist() for name, value in self._params.items()}
        drawn = None if self._drawn is None else self._drawn.tolist()
        for b in range(1 if self._after is None else len(self._after)):
            # Each entry may be changed where it is read, so lists are given anew.
            entry = {**self._note, "fields": _anew(self._note["fields"])}
            # What is NaN is not known, and not told.
            entry["params"] = {name: values[b] for name, values in listed.items() if values[b] == values[b]}
            if drawn is not None:
                entry["stream"] = drawn[b]
            if self._rows is not None:
                entry["rows"] = self._rows[b]
            if self._before is not None:
                entry["points_before"] = self._before[b]
            if self._after is not None:
                entry["points"] = self._after[b]
            yield entry


def read_in_histories(params: Mapping[str, Tensor], num: int) -> dict[str, Values]:
    """Keep the params worth reading in a history: a few numbers per cloud, not indices or noise.

    Those on another device stay there until somebody reads them.
    """
    kept: dict[str, Values] = {}
    for name, value in params.items():
        # By name, not by shape alone: with one point per cloud the shapes are the same.
        is_per_cloud = name not in _UNTOLD
        if is_per_cloud and isinstance(value, Tensor) and value.shape[:1] == (num,) and value.numel() <= 16 * num:
            kept[name] = value.detach().numpy() if value.is_cpu else value.detach()
    return kept


def _anew(fields: dict[str, Any]) -> dict[str, Any]:
    """Copy fields, and the lists of numbers, or of rows of numbers, among them."""
    copy = {**fields}
    for name, value in fields.items():
        if type(value) is list:
            copy[name] = [*map(list, value)] if value and type(value[0]) is list else [*value]
    return copy
