"""Which sensor's noise, how strong, and with how many lost readings, makes clean captures like those of the other."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from pcdata.rng import generator_for
from pcdata.sensors import SensorProfile, sensor_profiles
from pcdata.structures import DepthFrame
from pcdata.transforms import RandomSensorNoise
from pcdata.validation.comparison.depth_images import measure_depth
from pcdata.validation.comparison.distances import middle_of

Numbers = Mapping[str, float]  # noise@class, flying, holes_edges, holes_inside

CAPTURES = 6  # that a step is tried on while it is fitted
_ROUNDS = 5
_UNLIKELY = 0.1  # of the logarithm of a strength, beside the misfit in the logarithm of noise
_LEAST_STRENGTH = 0.02
_GRAZING_OFF = 90.0
_SPARE = 0.002  # of the image: what surfaces seen too flatly lose more than the other source loses


def applied(step: RandomSensorNoise, frame: DepthFrame, sample_id: str) -> DepthFrame:
    """Run the step as a dataset's first epoch would draw it."""
    made = step(frame, generator=generator_for(0, 0, sample_id))
    assert isinstance(made, DepthFrame)
    return made


def fitted_sensor_noise(clean: Sequence[tuple[str, DepthFrame]], target: Numbers) -> RandomSensorNoise | None:
    """Return the step that gives clean captures the noise and the holes of ``target``; None where none does.

    The sensor is the one whose noise grows with distance like that of the target, and whose own strength comes
    closest; strength, flying pixels and lost readings are found by trying them.
    """
    if not clean:
        return None
    before = _mean([frame for _, frame in clean])
    focal = float(np.mean([frame.camera.intrinsics[:, 0, 0].abs().mean().item() for _, frame in clean]))
    extra = {
        int(name[6:]): math.sqrt(target[name] ** 2 - value**2)
        for name, value in before.items()
        if name.startswith("noise@") and target.get(name, 0.0) > value
    }
    profile, strength = _sensor(extra, focal)
    fields = {"strength": strength, "flying_pixels": 0.1, "edge_dropout": 0.4, "dropout": 0.005}
    grazing = 80.0
    for number in range(_ROUNDS):
        step = _step(profile, grazing, fields)
        now = _mean([applied(step, frame, sample_id) for sample_id, frame in clean])
        if fields["strength"]:
            factor = _factor(before, now, target)
            fields["strength"] *= factor
            if not number:  # what is measured on flat parts is less than what was drawn, by a factor that is known now
                profile, fields["strength"] = _sensor({k: factor * value for k, value in extra.items()}, focal)
        fields["dropout"] = _kept(fields["dropout"] + target.get("holes_inside", 0.0) - now.get("holes_inside", 0.0))
        for name, measure in (("edge_dropout", "holes_edges"), ("flying_pixels", "flying")):
            wanted, made = (one.get(measure, 0.0) - before.get(measure, 0.0) for one in (target, now))
            fields[name] = _kept(fields[name] * max(wanted, 0.0) / made if made > 1e-6 else fields[name])
        lost = now.get("holes_inside", 0.0) - target.get("holes_inside", 0.0)
        if not fields["dropout"] and lost > _SPARE and grazing < _GRAZING_OFF:
            grazing = _GRAZING_OFF
    fields = {name: float(f"{value:.3g}") for name, value in fields.items()}
    return _step(profile, grazing, fields)


def _step(profile: SensorProfile, grazing: float, fields: Mapping[str, float]) -> RandomSensorNoise:
    return RandomSensorNoise(
        sensor=profile.name,
        grazing_degrees=grazing,
        strength=fields["strength"],
        flying_pixels=fields["flying_pixels"],
        edge_dropout=fields["edge_dropout"],
        dropout=fields["dropout"],
    )


def _sensor(extra: Mapping[int, float], focal: float) -> tuple[SensorProfile, float]:
    """Return the profile whose noise is like that which is missing, by class of distances, and its strength."""
    cameras = [one for one in sensor_profiles().values() if one.is_organized]
    if not extra:
        return cameras[0], 0.0
    best = (math.inf, cameras[0], 0.0)
    for profile in cameras:
        ratios = np.log([value / profile.noise_at(middle_of(k), focal=focal) for k, value in extra.items()])
        strength = float(np.median(ratios))
        badness = float(np.abs(ratios - strength).mean()) + _UNLIKELY * abs(strength)
        if badness < best[0]:
            best = (badness, profile, math.exp(strength))
    return best[1], max(best[2], _LEAST_STRENGTH)


def _factor(before: Numbers, now: Numbers, target: Numbers) -> float:
    """Return by how much the strength is too small."""
    found = [
        math.sqrt((target[name] ** 2 - own**2) / (now[name] ** 2 - own**2))
        for name, own in before.items()
        if name.startswith("noise@") and target.get(name, 0.0) > own and now.get(name, 0.0) > own
    ]
    return min(2.0, max(0.5, float(np.median(found)))) if found else 1.0


def _kept(share: float) -> float:
    return min(1.0, max(0.0, share))


def _mean(frames: Sequence[DepthFrame]) -> dict[str, float]:
    """Return the mean numbers of captures, over all views."""
    told: dict[str, list[float]] = {}
    for frame in frames:
        for view in range(frame.num_views):
            focal = abs(float(frame.camera.intrinsics[view, 0, 0]))
            for name, value in measure_depth(frame.depth[view].cpu().numpy(), focal).items():
                told.setdefault(name, []).append(value)
    return {name: float(np.mean(values)) for name, values in told.items()}
