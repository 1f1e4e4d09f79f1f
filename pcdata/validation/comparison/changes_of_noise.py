"""What may close differences of noise, holes and density: a sensor's errors, filled holes, jitter, fewer points."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pcdata.rng import generator_for
from pcdata.structures import DepthFrame, PointCloud
from pcdata.transforms import FarthestPointSample, FillHoles, RandomJitter, Transform, VoxelDownsample
from pcdata.validation.comparison.changes import step_change
from pcdata.validation.comparison.clouds import measure_points
from pcdata.validation.comparison.sensor_fit import CAPTURES, applied, fitted_sensor_noise
from pcdata.validation.comparison.sides import Change, Side
from pcdata.validation.comparison.tables import Table, bad, bad_families

_SMALL = 3.0  # pixels across: holes that single lost readings make
_FIT = ("noise", "flying", "holes_edges", "holes_inside")
_ROUNDS = 3


def find_sensor_noise(sides: tuple[Side, Side], table: Table) -> Change | None:
    """One source has more noise, or more small holes."""
    families = bad_families(table) & {"noise", "holes", "flying pixels"}
    if not families or sides[0].fact("kind") != "depth images":
        return None
    clean = _cleaner(table, families)
    other = sides[1 - clean]
    if "noise" not in families and other.middle("hole_width") > _SMALL:
        return None
    frames = [(name, one) for name, one in sides[clean].some(CAPTURES) if isinstance(one, DepthFrame)]
    target: dict[str, list[float]] = {}
    for key, one in table.items():
        if key[0].partition("@")[0] in _FIT and math.isfinite(value := (one.a, one.b)[1 - clean]):
            target.setdefault(key[0], []).append(value)
    step = fitted_sensor_noise(frames, {name: float(np.mean(values)) for name, values in target.items()})
    if step is None:
        return None
    return Change(
        name="noise",
        side=clean,
        families=frozenset({"noise", "holes", "flying pixels"}),
        apply=lambda frame, sample_id: applied(step, frame, sample_id),
        step=step.to_config(),
        advice=f"put {step!r} into the pipeline of {'AB'[clean]}",
    )


def _cleaner(table: Table, families: set[str]) -> int:
    """Return the side with less noise; where noise is the same, the one with fewer holes."""
    for family in ("noise", "holes", "flying pixels"):
        if family in families:
            more = sum(1 if one.b > one.a else -1 for one in table.values() if one.family == family and one.differs)
            return 0 if more > 0 else 1
    return 0


def find_holes(sides: tuple[Side, Side], table: Table) -> Change | None:
    """One source has holes that are not the sensor's noise."""
    if "holes" not in bad_families(table) or sides[0].fact("kind") != "depth images":
        return None
    side = 0 if sides[0].middle("holes") > sides[1].middle("holes") else 1
    if sides[1 - side].middle("holes") > 0.01:  # both have some, and the step would fill them all
        return None
    return step_change("holes", side, {"holes"}, FillHoles())


def find_jitter(sides: tuple[Side, Side], table: Table) -> Change | None:
    """One source of clouds has more noise."""
    rows = [table[key] for key in bad(table) if table[key].family == "noise"]
    if not rows or sides[0].fact("kind") != "point clouds":
        return None
    clean = 0 if sum(one.b - one.a for one in rows) > 0 else 1
    gaps = [math.sqrt(abs(one.b**2 - one.a**2)) for one in rows]
    step = RandomJitter(sigma=float(f"{np.median(gaps):.3g}"))
    return Change(
        name="noise",
        side=clean,
        families=frozenset({"noise"}),
        apply=lambda cloud, sample_id: step(cloud, generator=generator_for(0, 0, sample_id)),
        step=step.to_config(),
        advice=f"put {step!r} into the pipeline of {'AB'[clean]}",
    )


def find_density(sides: tuple[Side, Side], table: Table) -> Change | None:
    """One source of clouds has more points."""
    if "density" not in bad_families(table) or sides[0].fact("kind") != "point clouds":
        return None
    side = 0 if sides[0].middle("points") > sides[1].middle("points") else 1
    other = sides[1 - side]
    counts = other.series.values("points", None)
    step: Transform | None
    if np.nanmin(counts) == np.nanmax(counts) > 0 and other.series.count > 1:
        step = FarthestPointSample(num_points=int(counts[0]), if_short="keep")
    else:
        step = _fitted_voxels(sides[side], table, other is sides[1])
    return None if step is None else step_change("density", side, {"density"}, step)


def _fitted_voxels(dense: Side, table: Table, target_is_b: bool) -> VoxelDownsample | None:
    """Return the voxels that leave as many points on a square metre as the other source has."""
    wanted = {key[0]: one.b if target_is_b else one.a for key, one in table.items() if key[0].startswith("density@")}
    wanted = {name: value for name, value in wanted.items() if math.isfinite(value) and value > 0}
    clouds = [one for _, one in dense.some(CAPTURES) if isinstance(one, PointCloud)]
    if not wanted or not clouds:
        return None
    size = 1 / math.sqrt(float(np.median([*wanted.values()])))
    for _ in range(_ROUNDS):
        step = VoxelDownsample(voxel_size=float(f"{size:.3g}"))
        ratios = [
            value / wanted[name]
            for cloud in clouds
            for name, value in _measured(step(cloud)).items()
            if name in wanted and value > 0
        ]
        if not ratios:
            return None
        size *= math.sqrt(float(np.median(ratios)))
    return VoxelDownsample(voxel_size=float(f"{size:.3g}"))


def _measured(cloud: Any) -> dict[str, float]:
    viewpoint = cloud.viewpoint[0] if cloud.viewpoint is not None and len(cloud.viewpoint) == 1 else None
    return measure_points(cloud.points.cpu(), viewpoint)
