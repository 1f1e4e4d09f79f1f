"""RandomApply: a step that happens to each cloud with a probability."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from pcdata.errors import ConfigError
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.decisions import Decision, Decisions, Entry, in_a_row
from pcdata.transforms.field_types import Fraction


class RandomApply(Transform):
    """Apply a step to each cloud with a probability."""

    is_random = True

    step: Transform
    probability: Fraction = 0.5

    def check_fields(self) -> None:
        """Require a step from clouds to clouds."""
        if not (self.step.takes is PointCloud and self.step.gives is PointCloud):
            raise ConfigError(f"RandomApply: {type(self.step).__name__} does not turn clouds into clouds")
        self.keeps_clouds = self.step.keeps_clouds  # type: ignore[misc]

    def parts(self) -> list[Transform]:
        """The step that is applied, or its parts."""
        return self.step.parts()

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw, per cloud, whether it is chosen and the seed of what happens to it then."""
        chosen = streams.uniform(0.0, 1.0) < self.probability
        return {"chosen": chosen, "seed": streams.seeds()}

    def find_decision(self, entries: Sequence[Entry], stop: int) -> tuple[Decision, int] | None:
        """Return whether the cloud was chosen, and what happened to it then."""
        found = super().find_decision(entries, stop)
        if found is None:
            return None
        # Views that were merged went the same way, or their history says that it is of one.
        params = found[0].of_view(0).entry.get("params")
        if not (isinstance(params, Mapping) and params.get("chosen")):
            return found
        within = in_a_row([self.step], entries, stop - 1)
        return None if within is None else (Decision(entries[stop - 1], stop - 1, within[0]), within[1])

    def replayed(self, data: PointCloud, decided: Decisions) -> PointCloud:
        """Repeat what happened to the chosen clouds."""
        self.check_input(data)
        clouds = data.unbatch()
        for b, decision in enumerate(decided.of_clouds):
            if decision.within:
                clouds[b] = self.step.replayed(clouds[b], Decisions(type(self.step).__name__, decision.within))
        like = {
            "chosen": torch.empty(0, dtype=torch.bool, device="cpu"),
            "seed": torch.empty(0, dtype=torch.int64, device="cpu"),
        }
        params = {name: decided.values(name, like=value) for name, value in like.items()}
        return self.recorded(data, PointCloud.cat(clouds), params, decided.streams().here())

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Run the step on the chosen clouds and pack all again."""
        clouds = data.unbatch()
        for b, (chosen, seed) in enumerate(zip(params["chosen"].tolist(), params["seed"].tolist(), strict=True)):
            if chosen:
                clouds[b] = self.step(clouds[b], generator=Streams([seed]))
        return PointCloud.cat(clouds)
