"""Is the unit of depth right? Every usual unit is tried on the numbers as they were stored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from pcdata.functional.depth.unit_fit import (
    DEPTH_ENCODINGS,
    DepthEncoding,
    DepthUnit,
    UnitFit,
    encoded,
    unit_fits,
    units_in_words,
)
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.verdicts import Finding, Verdict

NAME = "depth_unit"
_SURE = 0.94  # probability of a unit that passes; wrong ones reach 0.90 on scenes without noise to judge by
_NAMED = 0.01  # of a unit that is worth a mention
_REFUTED = 0.02  # of a unit that fails
_SAME = 0.01  # of the distance: units that give equal depth are one
# Units in which depth in memory may have been stored, the coarsest that fits first.
_GRIDS = (0.01, 1 / 256, 0.001, 0.00025, 0.0002, 0.0001, 0.00001)
_OFF_GRID = 0.02  # of a unit: what float32 adds to whole numbers below 65536


def depth_unit_check(
    depth: Tensor,  # (H, W) metres, or (1, N) where there is no image; 0 = no reading
    limits: CaptureLimits,
    facts: Mapping[str, Any],  # provenance: metres_per_unit, depth_encoding, unit_is_recorded
    *,
    focal: float | None = None,
    view: int | None = None,
) -> Finding:
    """Pass a unit that alone fits the numbers, warn where others fit too and name them, fail one that does not fit.

    Half of the readings beyond twice the workspace warn, whatever the unit; where none is stated, beyond twice where
    the scene of a robot's camera usually is.
    """
    values, unit, is_known = stored_numbers(depth, facts)
    readings = depth[depth > 0]
    median = float(readings.median())
    near, far = limits.expected
    beyond = max(near / median, median / far)
    fits = unit_fits(
        values,
        declared=unit,
        focal=focal,
        workspace=limits.expected,
        workspace_is_known=limits.workspace_is_stated,
        known_units=[unit.metres] if facts.get("unit_is_recorded") and is_known else limits.units,
    )
    own_median = next((fit.median for fit in fits if fit.unit == unit), median)
    probability = sum(fit.probability for fit in fits if abs(fit.median / own_median - 1) < _SAME)
    others = [fit for fit in fits if fit.probability >= _NAMED and abs(fit.median / own_median - 1) >= _SAME]
    own = [UnitFit(unit, probability, median)] if probability >= _REFUTED else []
    told = "usual" if limits.workspace is None else "the workspace"
    found = f"half of the readings lie within {median:.3g} m; {told} is {near:g} to {far:g} m"
    if probability < _REFUTED and others:
        verdict = Verdict.FAIL
        advice = f"{_mend(others, unit, is_known)}{_doubt(others)}"
    elif probability < _SURE and others:
        verdict = Verdict.WARN
        ranked = sorted([*own, *others], key=lambda fit: -fit.probability)
        found += f"; several units fit: {units_in_words(ranked)}"
        advice = (
            f"which is right? {_mend(others, unit, is_known)}, or leave it; to tell them apart measure a distance in "
            "the scene and give --workspace NEAR FAR around it, or --sensor NAME"
        )
    elif beyond > 2:
        verdict = Verdict.WARN
        advice = "no other usual unit fits better: if the scene is that far away, say so with --workspace NEAR FAR"
        if median < near:
            advice = "no other usual unit fits better: if the scene is that near, say so with --workspace NEAR FAR"
    else:
        verdict, advice = Verdict.PASS, ""
    return Finding(
        name=NAME,
        verdict=verdict,
        found=found,
        value=median,
        threshold=2 * far if median > near else near / 2,
        fails_at=None,
        unit="m",
        advice=advice,
        view=view,
    )


def stored_numbers(depth: Tensor, facts: Mapping[str, Any]) -> tuple[NDArray[Any], DepthUnit, bool]:
    """Return depth as the numbers that a file had, or may have had, their unit, and whether the unit is known.

    It is where a file or its reader said it; else it is what the numbers look like.
    """
    metres = depth.detach().cpu().numpy().astype(np.float64)
    stated = facts.get("metres_per_unit")
    encoding: DepthEncoding = next((one for one in DEPTH_ENCODINGS if one == facts.get("depth_encoding")), "plain")
    if isinstance(stated, (int, float)) and stated > 0:
        if (whole := _whole(metres, float(stated))) is not None:
            return encoded(whole, encoding), DepthUnit(float(stated), encoding), True
        return metres / float(stated), DepthUnit(float(stated)), True
    grids = _GRIDS if len(metres) > 1 else ()  # a cloud has no pixels: its numbers never were an image's integers
    for unit in grids:
        if (whole := _whole(metres, unit)) is not None:
            return whole, DepthUnit(unit), False
    return metres, DepthUnit(1.0), False


def _whole(metres: NDArray[np.float64], unit: float) -> NDArray[np.uint16] | None:
    numbers = metres / unit
    whole = np.rint(numbers)
    if whole.max() > 65535 or len(numbers) == 0 or (np.abs(numbers - whole) > _OFF_GRID).any():
        return None
    return whole.astype(np.uint16)


def _mend(others: Sequence[UnitFit], unit: DepthUnit, is_known: bool) -> str:
    """Say what to change; options where the unit came with the file, factors where the depth was made in memory."""
    if is_known:
        told = " or ".join(f"{fit.unit.flags} (half within {fit.median:.3g} m)" for fit in others)
        return f"read them with {told}, in Python metres_per_unit= and depth_encoding="
    factors = (
        f"{fit.unit.metres / unit.metres:.6g} (half within {fit.median:.3g} m)"
        if fit.unit.encoding == "plain"
        else f"decode the {fit.unit.encoding} bits with {fit.unit} (half within {fit.median:.3g} m)"
        for fit in others
    )
    return "multiply depth by " + " or ".join(factors)


def _doubt(others: Sequence[UnitFit]) -> str:
    if len(others) < 2:
        return "; if a measured distance says otherwise, give --workspace NEAR FAR around it"
    return "; several fit: measure a distance in the scene to choose, and give --workspace NEAR FAR around it"
