"""Do steps drop too much? Judged from the counts that every cloud's history keeps.

Two questions, for every step of a chain. Is what the median capture loses usual for such a step? The ranges are in
:data:`USUAL`, with their reasons. And does one capture lose far more or less than the rest of the same build? That is
judged by the data set's own spread: the median and the median absolute deviation of the logarithm of what is left, so
that neither the outliers themselves nor the size of the clouds move the limit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcdata.verdicts import Finding, Verdict

Counts = Sequence[tuple[str, int]]  # step -> points after it, in the order of the steps

PERCENTILES = {"min": 0, "p5": 5, "median": 50, "p95": 95, "max": 100}


class _Usual(NamedTuple):
    """The shares of its points that a step of some kind loses in the median capture."""

    least: float
    most: float
    advice: str


_ANY = _Usual(0.0, 0.99, "a step that leaves one point in a hundred is seldom meant: look at its fields and its unit")
_OUTLIERS = "surfaces go with the noise: use a larger radius, fewer neighbors, or a larger std_ratio, or sample first"
_CROP = "the box holds next to nothing of the captures: look at its frame, its unit, and the poses"
USUAL: Mapping[str, _Usual] = {
    # Cantelli: beyond the mean and two standard deviations lies a fifth at most, and of a surface with noise 1 to 5 %.
    "RemoveStatisticalOutliers": _Usual(0.0, 0.15, _OUTLIERS),
    # Of a surface sampled finer than the radius only its edges and stray points have few neighbors.
    "RemoveRadiusOutliers": _Usual(0.0, 0.15, _OUTLIERS),
    # A table is most of what a camera above it sees; less than a fiftieth is no plane that things stand on.
    "RemovePlane": _Usual(
        0.02,
        0.995,
        "it measured no table, of which a warning tells and says what to do, or took another plane than the one that "
        "things stand on: then give distance, up and max_tilt",
    ),
    "CropWorkspace": _Usual(0.0, 0.99, _CROP),
    "CropPolygon": _Usual(0.0, 0.99, _CROP),
    "CropCenter": _Usual(0.0, 0.99, _CROP),
    # Of clutter on a table, objects are what is left: noise between them is the smaller part.
    "ClusterObjects": _Usual(
        0.0,
        0.7,
        "most of what is left is noise, or in clusters under or over the limits of size, which meta['no_objects'] "
        "counts: of noise use a larger eps or fewer min_points, of clusters other limits, or remove the table before",
    ),
    "SplitObjects": _Usual(0.0, 0.7, "most of what is left is in no object: use a larger eps, or other limits of size"),
    # These leave the number that somebody asked for; see _MOST_REPEATS for the other end.
    **dict.fromkeys(
        (
            *("FarthestPointSample", "RandomFarthestPointSample", "RandomSample", "RandomPointCount"),
            *("RandomVoxelSample", "VoxelSample", "RandomCuboid"),
        ),
        _Usual(0.0, 1.0, ""),
    ),
}

_FEWEST = 5  # captures, below which none is called an outlier of the rest
# The least spread that is believed, however alike captures are: 5 % more or fewer points are no news where a step keeps
# nearly all. What is left of a step that keeps little, such as objects on a plane, differs from scene to scene.
_SPREAD, _SPREAD_OF_LITTLE = 0.05, 0.2
_SPREAD_AT_FIRST = 0.1  # of the points that a capture begins with
_DEVIATIONS = 6.0  # robust standard deviations; of normal data one capture in 500 million is farther out
_MOST_REPEATS = 0.5  # of the points after a step, those that are copies of others
_SHOWN = 5
_MAD_TO_SIGMA = 1.4826  # of normal data


def judge_step_losses(counts: Mapping[str, Counts]) -> list[Finding]:
    """Judge what the steps of a build drop; every finding warns, and there is none where all is usual.

    Args:
        counts: sample id -> the points after every step, as a build's report has them. Captures that went through
            other steps, such as clouds among depth images, are judged by themselves.
    """
    found = []
    for names, (ids, table) in _chains(counts).items():
        for place, step in enumerate(names):
            before, after = table[:, place - 1] if place else None, table[:, place]
            found += _of_the_median(step, before, after)
            found += _of_the_rest(step, ids, before, after)
    return found


def step_statistics(counts: Mapping[str, Counts]) -> list[dict[str, Any]]:
    """Return how many points every step left, as plain numbers: the smallest, the largest and percentiles.

    Chains of different steps follow each other; ``samples`` tells how many captures went through each, ``before`` the
    median before the step, where points are known.
    """
    return [
        {
            "step": step,
            "samples": len(ids),
            "before": _percentiles(table[:, place - 1])["median"] if place else None,
            **_percentiles(table[:, place]),
        }
        for names, (ids, table) in _chains(counts).items()
        for place, step in enumerate(names)
    ]


def _percentiles(values: NDArray[np.int64]) -> dict[str, int]:
    found = np.percentile(values, list(PERCENTILES.values()), method="nearest")
    return dict(zip(PERCENTILES, map(int, found)))


def _chains(counts: Mapping[str, Counts]) -> dict[tuple[str, ...], tuple[list[str], NDArray[np.int64]]]:
    rows: dict[tuple[str, ...], tuple[list[str], list[list[int]]]] = {}
    for sample_id, steps in counts.items():
        ids, table = rows.setdefault(tuple(name for name, _ in steps), ([], []))
        ids.append(sample_id)
        table.append([count for _, count in steps])
    return {names: (ids, np.array(table, np.int64)) for names, (ids, table) in rows.items() if names}


def _of_the_median(step: str, before: NDArray[np.int64] | None, after: NDArray[np.int64]) -> list[Finding]:
    if before is None:
        return []
    is_full = before > 0
    if not is_full.any():
        return []
    left = after[is_full] / before[is_full]
    lost = 1.0 - float(np.median(left))
    usual = USUAL.get(step, _ANY)
    if lost > usual.most:
        return [_warning(step, lost, usual.most, f"loses {lost:.1%} of the points of the median capture", usual.advice)]
    if 0 < usual.least > lost:
        told = f"loses {lost:.1%} of the points of the median capture"
        return [_warning(step, lost, usual.least, told, usual.advice, at_least=True)]
    repeats = 1.0 - 1.0 / max(1.0, float(np.median(left)))
    if repeats > _MOST_REPEATS:
        told = f"of the points of the median capture {repeats:.1%} are copies of others, there being too few"
        advice = "ask for fewer points, or let the steps before leave more"
        return [_warning(step, repeats, _MOST_REPEATS, told, advice)]
    return []


def _of_the_rest(
    step: str, ids: Sequence[str], before: NDArray[np.int64] | None, after: NDArray[np.int64]
) -> list[Finding]:
    """Find the captures that lose far more or less than the others; what has no points before was told before."""
    places = np.arange(len(ids)) if before is None else np.flatnonzero(before > 0)
    if len(places) < _FEWEST:
        return []
    left = np.log1p(after[places]) - (0.0 if before is None else np.log1p(before[places]))
    middle = float(np.median(left))
    kept = min(1.0, float(np.exp(middle)))
    least = _SPREAD_AT_FIRST if before is None else _SPREAD * kept + _SPREAD_OF_LITTLE * (1 - kept)
    spread = max(_MAD_TO_SIGMA * float(np.median(np.abs(left - middle))), least)
    away = np.abs(left - middle) / spread
    odd = np.flatnonzero(away > _DEVIATIONS)
    if not len(odd):
        return []
    odd = odd[np.argsort(-away[odd], kind="stable")]
    what = "points" if before is None else "of its points"

    def told(place: int) -> str:
        number = places[place]
        kept = f"{after[number]:,}" if before is None else f"{after[number] / before[number]:.1%}"
        return f"{ids[number]!r:.100} keeps {kept}"

    usual = f"{np.median(after):,.0f}" if before is None else f"{np.expm1(middle) + 1:.1%}"
    named = ", ".join(told(int(place)) for place in odd[:_SHOWN])
    more = f" and {len(odd) - _SHOWN} more" if len(odd) > _SHOWN else ""
    found = (
        f"{len(odd)} of {len(ids)} captures are outliers of the rest: {named}{more}; the median keeps {usual} {what}"
    )
    advice = "look at them with 'pcdata validate', and leave out what is bad with --skip ID"
    return [_warning(step, float(away[odd[0]]), _DEVIATIONS, found, advice)]


def _warning(step: str, value: float, limit: float, found: str, advice: str, *, at_least: bool = False) -> Finding:
    return Finding(
        name=step,
        verdict=Verdict.WARN,
        found=found,
        value=value,
        threshold=limit,
        at_least=at_least,
        advice=advice,
    )
