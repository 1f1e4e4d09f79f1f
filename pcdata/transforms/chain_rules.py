"""What makes a chain of steps valid, and what makes it slow."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence

from pcdata.errors import ConfigError, PcdataWarning
from pcdata.structures import METRE, NORMALIZED, PointCloud
from pcdata.transforms.base import Transform, unit_advice
from pcdata.transforms.field_checks import faulty_config


class PipelineOrderWarning(PcdataWarning):
    """A pipeline is valid but its order costs time or quality."""


def check_chain(steps: Sequence[Transform]) -> None:
    """Require that neighbors fit: capture or cloud, frame, unit.

    Raises:
        ConfigError: the first step that does not fit; its path is the position of the step from 0.
    """
    for position, (before, after) in enumerate(itertools.pairwise(steps), start=1):
        if not issubclass(before.gives, after.takes):
            raise _misfit(
                position,
                after,
                f"takes a {after.takes.__name__} but step {position}, {type(before).__name__}, gives a "
                f"{before.gives.__name__}" + ("; put Deproject between them" if before.gives is not PointCloud else ""),
            )
    frame: str | None = None
    unit = METRE if steps and not issubclass(PointCloud, steps[0].takes) else None  # None: that of whatever comes in
    for position, outer in enumerate(steps):
        for step in outer.parts() if outer._modules else (outer,):
            needed = step.frame_needed()
            if frame is not None and needed is not None and needed != frame:
                way = f"put ToFrame(frame={needed!r}) before it"
                if frame.startswith(f"{needed}/"):  # no pose leads back from what a step made of each cloud's points
                    way = f"put it before the step that leaves {needed!r}"
                what = f"works in frame {needed!r} but the cloud is in {frame!r} there; {way}"
                raise _misfit(position, step, what)
            wanted = step.unit_needed()
            if unit is not None and wanted is not None and wanted != unit:
                names = {METRE: "in metres", NORMALIZED: "normalized"}
                works = "in metres" if wanted == METRE else "on normalized clouds"
                raise _misfit(
                    position, step, f"works {works} but the cloud is {names[unit]} there; {unit_advice(step)}"
                )
            frame = step.frame_after(frame)
            unit = step.unit_given() or wanted or unit


def warn_of_order(steps: Sequence[Transform], *, stacklevel: int) -> None:
    """Warn where statistics run before the crop."""
    flat = [step for outer in steps for step in (outer.parts() if outer._modules else (outer,))]
    names = [type(step).__name__ for step in flat]
    statistics = [i for i, step in enumerate(flat) if step.runs_statistics]
    if not statistics or "CropWorkspace" not in names:
        return
    early = statistics[0]
    if "CropWorkspace" in names[early:] and "CropWorkspace" not in names[:early]:
        warnings.warn(
            f"{names[early]} runs before CropWorkspace: cropping first is cheaper, and statistics of the workspace "
            "alone find more of its outliers",
            PipelineOrderWarning,
            stacklevel=stacklevel + 1,
        )


def _misfit(position: int, step: Transform, what: str) -> ConfigError:
    message = f"step {position + 1}, {type(step).__name__}, {what}"
    return faulty_config(f"Compose: {message}", [((position,), message)])
