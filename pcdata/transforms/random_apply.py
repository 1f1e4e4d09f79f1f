"""Steps that happen by chance: RandomApply, RandomOneOf."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import nn

from pcdata.errors import ConfigError, ReplayError
from pcdata.rng import Streams
from pcdata.structures import DepthFrame, PointCloud
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.decisions import Decision, Decisions, Entry, in_a_row
from pcdata.transforms.field_types import Fraction, NonNegative


class _Chance(Transform, abstract=True):
    """Run a step that is drawn for each cloud or capture, or none: ``chosen`` in the params says which."""

    is_random = True

    def _choices(self) -> list[Transform]:
        raise NotImplementedError

    def _is_choice(self, chosen: Any) -> bool:
        """Whether a value, which may be of a damaged history, is one of ``chosen``."""
        raise NotImplementedError

    def _step(self, chosen: Any) -> Transform | None:
        """Return the step that is run; None = none."""
        raise NotImplementedError

    def check_fields(self) -> None:
        """Require steps from clouds to clouds, or from captures to captures."""
        steps = self._choices()
        takes = DepthFrame if any(step.takes is DepthFrame for step in steps) else PointCloud
        what = "captures into captures" if takes is DepthFrame else "clouds into clouds"
        for step in steps:
            # A chain without steps leaves either as it is.
            if step.parts() and not (step.takes is takes and step.gives is takes):
                raise ConfigError(f"{type(self).__name__}: {type(step).__name__} does not turn {what}")
        self.takes = self.gives = takes  # type: ignore[misc]
        self.keeps_clouds = all(step.keeps_clouds for step in steps)  # type: ignore[misc]

    def parts(self) -> list[Transform]:
        """The steps that may be run, or their parts."""
        return [part for step in self._choices() for part in step.parts()]

    def find_decision(self, entries: Sequence[Entry], stop: int) -> tuple[Decision, int] | None:
        """Return what was chosen, and what happened to the cloud then."""
        found = super().find_decision(entries, stop)
        if found is None:
            return None
        # Views that were merged went the same way, or their history says that it is of one.
        params = found[0].of_view(0).entry.get("params")
        chosen = params.get("chosen") if isinstance(params, Mapping) else None
        step = self._step(chosen) if self._is_choice(chosen) else None
        if step is None or not step.parts():
            return found
        within = in_a_row([step], entries, stop - 1)
        return None if within is None else (Decision(entries[stop - 1], stop - 1, within[0]), within[1])

    def replayed(self, data: Any, decided: Decisions) -> Any:
        """Repeat what happened to each cloud, or to the capture."""
        self.check_input(data)
        clouds, choices = _parts_of(data), []
        for b, decision in enumerate(decided.of_clouds):
            chosen = decided.told(b).get("chosen")
            if not self._is_choice(chosen):
                raise ReplayError(
                    f"{type(self).__name__}: the history does not tell what was chosen, got {chosen!r:.50}"
                )
            choices.append(chosen)
            step = self._step(chosen)
            if step is not None and decision.within:
                clouds[b] = step.replayed(clouds[b], Decisions(type(step).__name__, decision.within))
        seeds = decided.values("seed", like=torch.empty(0, dtype=torch.int64, device="cpu"))
        dtype = torch.bool if isinstance(choices[0], bool) else torch.int64
        params = {"chosen": torch.tensor(choices, dtype=dtype, device="cpu"), "seed": seeds}
        return self.recorded(data, _joined(clouds), params, decided.streams().here())

    def transform(self, data: Any, params: Params) -> Any:
        """Run the chosen steps and pack all clouds again."""
        clouds = _parts_of(data)
        for b, (chosen, seed) in enumerate(zip(params["chosen"].tolist(), params["seed"].tolist(), strict=True)):
            step = self._step(chosen)
            if step is not None:
                clouds[b] = step(clouds[b], generator=Streams([seed]))
        return _joined(clouds)


def _parts_of(data: Any) -> list[Any]:
    return data.unbatch() if isinstance(data, PointCloud) else [data]


def _joined(parts: list[Any]) -> Any:
    if isinstance(parts[0], PointCloud):
        return PointCloud.cat(parts)
    (capture,) = parts
    return replace(capture)  # never the input itself


class RandomApply(_Chance):
    """Apply a step to each cloud, or to a capture, with a probability.

    Args:
        step: from clouds to clouds, or from captures to captures.
        probability: that it is applied.
    """

    step: Transform
    probability: Fraction = 0.5

    def _choices(self) -> list[Transform]:
        return [self.step]

    def _is_choice(self, chosen: Any) -> bool:
        return isinstance(chosen, bool)

    def _step(self, chosen: Any) -> Transform | None:
        return self.step if chosen else None

    def make_params(self, data: Any, streams: Streams) -> Params:
        """Draw, per cloud, whether it is chosen and the seed of what happens to it then."""
        chosen = streams.uniform(0.0, 1.0) < self.probability
        return {"chosen": chosen, "seed": streams.seeds()}


class RandomOneOf(_Chance):
    """Apply one of several steps to each cloud, or to a capture, drawn by their weights.

    Whatever is drawn, clouds stay in their frame and unit. An empty chain, ``Compose([])``, leaves all as it is.

    Args:
        steps: from clouds to clouds, or from captures to captures; a chain counts as one.
        weights: of each step, as parts of their sum; None = all alike.
    """

    steps: Sequence[Transform]
    weights: tuple[NonNegative, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.steps = nn.ModuleList(self.__dict__.pop("steps"))  # type: ignore[assignment]

    def config_fields(self) -> dict[str, Any]:
        """Return the fields by name, the steps as a list."""
        return {"steps": list(self.steps), "weights": self.weights}

    def _choices(self) -> list[Transform]:
        return list(self.steps)

    def _is_choice(self, chosen: Any) -> bool:
        return type(chosen) is int and 0 <= chosen < len(self.steps)

    def _step(self, chosen: Any) -> Transform | None:
        return self._choices()[chosen]

    def check_fields(self) -> None:
        """Require steps that keep frame and unit, and a weight for each."""
        super().check_fields()
        steps = self._choices()
        if not steps:
            raise ConfigError("RandomOneOf: steps must name steps to choose from")
        for step in steps:
            frame = next((part.frame_needed() for part in step.parts() if part.frame_needed()), "a frame")
            after = step.frame_after(frame)
            if after != frame or any(part.unit_given() for part in step.parts()):
                what = f"leads to frame {after!r}" if after != frame else "changes the unit"
                raise ConfigError(
                    f"RandomOneOf: {type(step).__name__} {what}, and the steps behind must know where clouds are; put "
                    "it before or behind, where every cloud goes through it"
                )
        if self.weights is not None and (len(self.weights) != len(steps) or not 0 < sum(self.weights) < math.inf):
            raise ConfigError(
                f"RandomOneOf: weights must be {len(steps)} numbers, one for each step, not all 0, got {self.weights}"
            )

    def make_params(self, data: Any, streams: Streams) -> Params:
        """Draw, per cloud, a number of a step and the seed of what happens to it then."""
        weights = torch.tensor(self.weights or [1.0] * len(self.steps), dtype=torch.float64, device="cpu")
        ends = weights.cumsum(0)
        # The first end beyond the draw: a step of weight 0 ends where the one before it does.
        chosen = torch.searchsorted(ends, streams.uniform(0.0, 1.0) * ends[-1], right=True)
        return {"chosen": chosen.clamp(max=int(weights.nonzero()[-1])), "seed": streams.seeds()}
