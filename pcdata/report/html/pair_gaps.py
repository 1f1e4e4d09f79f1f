"""How far the surfaces of every two cameras lie apart over several captures: what a page and a picture tell."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
from numpy.typing import NDArray

from pcdata.validation.overlap_result import PairOverlap
from pcdata.verdicts import Verdict


@dataclass(frozen=True, eq=False)
class PairGap:
    """Two cameras over several captures.

    Args:
        first: the name of one camera.
        second: of the other.
        half: metres, the median of the gaps, and of these the median over the captures; NaN = too little is shared.
        most: metres, within which 90 % are, the median over the captures; NaN as ``half``.
        shared: of both surfaces, 0..1, the median over the captures.
        counts: (60,) signed gaps from -15 to 15 mm, of all captures.
        verdict: the worst of the captures; unknown where ``half`` is NaN.
    """

    first: str
    second: str
    half: float
    most: float
    shared: float
    counts: NDArray[np.int64]
    verdict: Verdict


def pair_gaps(pairs: Iterable[PairOverlap]) -> list[PairGap]:
    """Return every two cameras of some captures, those farthest apart first."""
    found: dict[tuple[str, str], list[PairOverlap]] = {}
    for pair in pairs:
        found.setdefault((pair.first, pair.second), []).append(pair)
    gaps = [_gap(*names, own) for names, own in found.items()]
    return sorted(gaps, key=lambda gap: -gap.half if math.isfinite(gap.half) else math.inf)


def _gap(first: str, second: str, pairs: Sequence[PairOverlap]) -> PairGap:
    measured = [pair for pair in pairs if math.isfinite(pair.median)]
    return PairGap(
        first=first,
        second=second,
        half=median(pair.median for pair in measured) if measured else math.nan,
        most=median(pair.p90 for pair in measured) if measured else math.nan,
        shared=median(pair.overlap for pair in pairs),
        counts=np.sum([pair.histogram for pair in measured or pairs], axis=0, dtype=np.int64),
        verdict=max((pair.verdict for pair in measured), key=lambda one: one.severity, default=Verdict.UNKNOWN),
    )
