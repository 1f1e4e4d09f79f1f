"""How far views agree when their focal lengths are others than stated."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from pcdata.structures import DepthFrame
from pcdata.structures.structure import derived
from pcdata.validation.measures.pose_conventions import (
    CONVENTIONS,
    LEAST_COMPARED,
    Agreement,
    Reading,
    agreement,
    as_given,
    explains_more,
    share,
    total,
)

RATIOS = tuple(2.0 ** (step / 4) for step in (-4, -3, -2, -1, 1, 2, 3, 4))  # half to double; 9 % off at most between
LEAST_TOLD = 5 * LEAST_COMPARED  # readings that tell focal lengths: a few agree by chance under one of many
_LEAST_SHARE = 0.75  # of the readings that must agree: under right intrinsics and poses 82 to 98 % do
_CLEARLY = 0.05  # by which a ratio must explain more than any convention of poses and depth

Pair = tuple[int, int]


class FocalRatio(NamedTuple):
    """Views that agree when their focal lengths are so many times those stated."""

    ratio: float
    views: tuple[int, ...]
    share: float  # of the readings that these views share with any, which would agree


def scaled(ratio: float) -> Reading:
    """Return what reads a view with focal lengths ``ratio`` times those stated."""

    def read(view: DepthFrame) -> DepthFrame:
        k = view.camera.intrinsics.clone()
        k[:, :2, :2] *= ratio
        return derived(view, camera=derived(view.camera, intrinsics=k))

    return read


def explains_clearly(read: Agreement, given: Agreement, others: Iterable[float]) -> bool:
    """Whether a ratio makes views agree that do not as stated, and no convention of poses and depth does as well.

    Args:
        read: what agrees under the ratio.
        given: what agrees as stated.
        others: the shares that would agree under the conventions.
    """
    return (
        min(read[1], given[1]) >= LEAST_TOLD
        and share(read) >= _LEAST_SHARE
        and explains_more(share(read), share(given))
        and all(share(read) >= other + _CLEARLY for other in others)
    )


def best_ratio(views: Mapping[int, DepthFrame], given: Mapping[Pair, Agreement]) -> FocalRatio | None:
    """Return the ratio, of all views or of one alone, that explains clearly more than the intrinsics stated."""
    numbers = sorted({number for pair in given for number in pair})
    choices = [tuple(numbers), *((number,) for number in numbers if len(numbers) > 1)]
    found: list[tuple[float, FocalRatio, Agreement, Agreement]] = []
    for turned in choices:
        of_turned = [pair for pair in given if set(pair) & set(turned)]
        as_stated = total(given[pair] for pair in of_turned)
        rest = [given[pair] for pair in given if pair not in of_turned]
        for ratio in RATIOS:
            read = total(_agreements(views, of_turned, turned, scaled(ratio)))
            if explains_clearly(read, as_stated, ()):
                found.append((share(total([read, *rest])), FocalRatio(ratio, turned, share(read)), read, as_stated))
    if not found:
        return None
    _, best, read, as_stated = max(found, key=lambda one: one[0])
    of_best = [pair for pair in given if set(pair) & set(best.views)]
    others = (share(total(_agreements(views, of_best, best.views, said.read))) for said in CONVENTIONS.values())
    return best if explains_clearly(read, as_stated, others) else None


def _agreements(
    views: Mapping[int, DepthFrame], pairs: Iterable[Pair], turned: tuple[int, ...], read: Reading
) -> list[Agreement]:
    reads = {number: read if number in turned else as_given for number in views}
    return [agreement(views[i], views[j], reads[i], reads[j]) for i, j in pairs]
