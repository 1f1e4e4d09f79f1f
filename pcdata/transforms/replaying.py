"""Repeating what a history tells: each step of a chain is given what it decided about the clouds that reach it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from pcdata.errors import ReplayError
from pcdata.structures import PointCloud
from pcdata.transforms.decisions import Decision, Decisions, find_decisions, histories_of

if TYPE_CHECKING:
    from pcdata.transforms.base import Transform


def replayed_through(where: str, steps: Sequence[Transform], data: Any, history: Any) -> Any:
    """Run steps on data as a history says, see :meth:`pcdata.transforms.base.Transform.replay`."""
    histories, for_all = histories_of(where, history)
    found = [find_decisions(where, steps, one) for one in histories]
    # Of each cloud behind a step: whose history tells of it, and the view that it was before views were merged.
    clouds: list[tuple[int, int | None]] = [(number, None) for number in range(len(found))]
    levels = []
    for position in range(len(steps) - 1, -1, -1):  # from what came out back to what went in
        decisions = [found[number][position].of_view(view) for number, view in clouds]
        levels.append(decisions)
        origins = steps[position].origins(decisions)
        clouds = [(clouds[k][0], clouds[k][1] if view is None else view) for k, view in origins]
    for step, decisions in zip(steps, reversed(levels), strict=True):
        data = step.replayed(data, _for_data(step, data, decisions, for_all))
    return data


def _for_data(step: Transform, data: Any, decisions: list[Decision], for_all: bool) -> Decisions:
    """Return what a step decided about the clouds of the data, or about those that it makes of them."""
    name = type(step).__name__
    if step.keeps_clouds and isinstance(data, PointCloud):
        if for_all and len(decisions) == 1:
            decisions = decisions * data.num_clouds
        if len(decisions) != data.num_clouds:
            raise ReplayError(
                f"{name}: the histories tell of {len(decisions)} clouds and there are {data.num_clouds}; give the "
                "history of each, in their order, or that of one for all"
            )
    return Decisions(name, decisions)
