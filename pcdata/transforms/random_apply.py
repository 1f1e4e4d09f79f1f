"""RandomApply: a step that happens to each cloud with a probability."""

from __future__ import annotations

from pcdata.errors import ConfigError
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params, Transform
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

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Run the step on the chosen clouds and pack all again."""
        clouds = data.unbatch()
        for b, (chosen, seed) in enumerate(zip(params["chosen"].tolist(), params["seed"].tolist(), strict=True)):
            if chosen:
                clouds[b] = self.step(clouds[b], generator=Streams([seed]))
        return PointCloud.cat(clouds)
