"""Are the numbers lengths in metres, of the workspace, and not clipped?"""

from __future__ import annotations

from torch import Tensor

from pcdata.functional.extremes import pile_at_extreme
from pcdata.validation.check import Check, Verdict, graded
from pcdata.validation.limits import Limits

_SAMPLES = 1 << 17  # readings looked at: shares are then known to 0.2 %
_UNITS = (1000.0, 100.0, 10.0, 0.1, 0.01, 0.001)  # how far units are mistaken: mm, cm, the 0.1 mm of some sensors
_MOST = 0.5  # of all readings must lie in the workspace once the unit is set right
# And by so many more than before: where the median is far outside, and where a deep scene may reach beyond the end.
_GAIN = (0.1, 0.5)
_CODES = {65535: "the highest 16-bit number", 4095: "the highest 12-bit number", 32767: "the highest 15-bit number"}


def reading_checks(
    depth: Tensor,  # any shape, metres, 0 = no reading
    limits: Limits,
    *,
    metres_per_unit: float | None = None,  # of the file, where known
    view: int | None = None,
) -> list[Check]:
    """Judge the unit, the range and the ends of the range of the readings."""
    flat = depth.flatten()
    flat = flat[:: max(1, len(flat) // _SAMPLES)]
    readings = flat[flat > 0]
    if not len(readings):
        return []  # coverage has said so
    return [
        _unit(readings, limits, metres_per_unit, view),
        _range(readings, limits, view),
        _saturation(readings, limits, metres_per_unit, view),
    ]


def _unit(readings: Tensor, limits: Limits, metres_per_unit: float | None, view: int | None) -> Check:
    """A median twice beyond the workspace that a usual mistake of the unit explains fails; just outside it warns.

    Just outside without such an explanation it passes: how much lies within the workspace is judged on its own.
    """
    near, far = limits.workspace
    median = float(readings.median())
    beyond = max(near / median, median / far)
    factor = None if beyond <= 1 else _explaining_factor(readings, limits, _GAIN[beyond <= 2])
    advice = ""
    if beyond <= 1 or (factor is None and beyond <= 2):
        verdict = Verdict.PASS
    elif factor is None:
        verdict = Verdict.WARN
        advice = "if the scene is that far away, say so with workspace; else check the unit of depth"
    else:
        verdict = Verdict.FAIL if beyond > 2 else Verdict.WARN
        unit = "" if metres_per_unit is None else f", metres_per_unit={metres_per_unit * factor:g}"
        mistake = f"{1 / factor:g} times too long" if factor < 1 else f"{factor:g} times too short"
        advice = f"the unit looks {mistake}: multiply depth by {factor:g}{unit}; if the scene is so far, say workspace"
    fails_at = 2 * far if median > near else near / 2
    passes = (far if median > near else near) if factor is not None else fails_at
    return Check(
        name="depth_unit",
        verdict=verdict,
        found=f"half of the readings lie within {median:.3g} m; the workspace is {near:g} to {far:g} m",
        value=median,
        threshold=passes,
        fails_at=fails_at,
        unit="m",
        advice=advice,
        view=view,
    )


def _explaining_factor(readings: Tensor, limits: Limits, gain: float) -> float | None:
    """Return the mistake of the unit that brings most readings into the workspace, if that is clearly more than now.

    A deep scene at the end of the workspace is partly inside, and partly inside again once a factor moves it to the
    other end: that is no evidence.
    """
    shares = {factor: _share_inside(factor * readings, limits) for factor in _UNITS}
    best = max(shares, key=lambda factor: shares[factor])
    needed = max(_MOST, _share_inside(readings, limits) + gain)
    return best if shares[best] >= needed else None


def _share_inside(readings: Tensor, limits: Limits) -> float:
    near, far = limits.workspace
    return float(((readings >= near) & (readings <= far)).float().mean())


def _range(readings: Tensor, limits: Limits, view: int | None) -> Check:
    near, far = limits.workspace
    one_percent = len(readings) // 100
    low = float(readings.kthvalue(1 + one_percent).values)
    high = float(readings.kthvalue(len(readings) - one_percent).values)
    fraction = _share_inside(readings, limits)
    return graded(
        "workspace_fraction",
        fraction,
        threshold=limits.workspace_fraction[0],
        fails_at=limits.workspace_fraction[1],
        higher_is_better=True,
        found=f"98 % of the readings lie between {low:.3g} and {high:.3g} m",
        advice=f"move the camera, or give the workspace of this task instead of {near:g} to {far:g} m",
        view=view,
    )


def _saturation(readings: Tensor, limits: Limits, metres_per_unit: float | None, view: int | None) -> Check:
    piles = [pile for end in ("far", "near") if (pile := pile_at_extreme(readings, end=end)) is not None]
    pile = max(piles, key=lambda one: one.fraction, default=None)
    found, advice = "no pile of readings at either end of the range", ""
    if pile is not None:
        stored = None if metres_per_unit is None else round(pile.value / metres_per_unit)
        code = _CODES.get(stored or 0)
        found = f"{100 * pile.fraction:.2g} % of the readings are exactly {pile.value:.5g} m"
        advice = "clipped at the end of the sensor's range: store 0 there instead"
        if code is not None:
            found += f", stored as {stored}, {code}"
            advice = f"{stored} marks 'no reading' in some formats: say so: --invalid-values {stored}, or "
            advice += (
                f'"invalid_values": [{stored}] in intrinsics.json, in Python open_source(invalid_values=[{stored}])'
            )
    return graded(
        "saturation",
        0.0 if pile is None else pile.fraction,
        threshold=limits.saturation[0],
        fails_at=limits.saturation[1],
        found=found,
        advice=advice,
        view=view,
    )
