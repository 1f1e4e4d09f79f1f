"""How well objects were told apart: predicted labels against true ones, as the literature on unseen objects scores it.

Sources: Ochs, Malik, Brox, Segmentation of moving objects by long term video analysis, IEEE TPAMI 36(6), 2014 (overlap,
and the assignment); Perazzi et al., A benchmark dataset and evaluation methodology for video object segmentation, CVPR
2016 (boundaries); Xie et al., Unseen object instance segmentation for robotic environments, IEEE T-RO 37(5), 2021.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.contracts.numbers import checked_positive
from pcdata.errors import ConfigError, DTypeError, ShapeError

FOUND_ABOVE = 0.75  # an object counts as found where its F is higher


@dataclass(frozen=True)
class ObjectScore:
    """A true object, and the predicted one it was assigned.

    Args:
        label: of the true object.
        predicted: the label assigned to it; None = none was left that shares a pixel with it.
        f: of the two: 2 |both| / (|true| + |predicted|).
        iou: the largest |both| / |either| with any predicted object, assigned or not.
    """

    label: int
    predicted: int | None
    f: float
    iou: float


@dataclass(frozen=True)
class SegmentationScores:
    """What :func:`score_segmentation` finds; all scores lie in 0 to 1.

    Args:
        overlap_precision: part of all predicted object pixels that lie in the true object theirs is assigned to.
        overlap_recall: part of all true object pixels that lie in the predicted object assigned to theirs.
        overlap_f: the harmonic mean of both.
        boundary_precision: as overlap, of the predicted boundary pixels near the true boundary; None without an image.
        boundary_recall: of the true boundary pixels near the predicted boundary; None without an image.
        boundary_f: the harmonic mean of both; None without an image.
        found: part of the true objects whose F is above 0.75.
        mean_iou: of the true objects, each with the predicted object that it shares most with.
        num_predicted: predicted objects.
        objects: every true object.
    """

    overlap_precision: float
    overlap_recall: float
    overlap_f: float
    boundary_precision: float | None
    boundary_recall: float | None
    boundary_f: float | None
    found: float
    mean_iou: float
    num_predicted: int
    objects: tuple[ObjectScore, ...]


def score_segmentation(
    predicted: Tensor,  # (H, W) or (N,) integers, negative = no object
    true: Tensor,  # of the same shape
    *,
    ignore: Tensor | None = None,  # of the same shape, bool
    tolerance: float = 0.003,
) -> SegmentationScores:
    """Score predicted objects against true ones; the background is not scored.

    Every predicted object is compared with every true one by F = 2 |both| / (|true| + |predicted|), and they are
    assigned one to one so that the sum of F is largest (Hungarian method). Boundaries are compared between assigned
    objects: a pixel is on a boundary where the mask differs from its right, lower or lower right neighbor, and it is
    matched where the other boundary is within ``tolerance``.

    With no true object the recalls, found and mean_iou are 1; with no predicted object the precisions are 1. So an
    empty scene where nothing is predicted scores 1, and F is 0 where only one of the two is empty.

    Args:
        predicted: the labels to judge; an image, or the rows of a cloud, which have no boundary.
        true: the right labels.
        ignore: what counts for neither: pixels whose truth nobody knows.
        tolerance: of boundaries, in parts of the image's diagonal, rounded up to whole pixels (0.003: 3 of 640x480);
            1 and more are pixels.

    Raises:
        ShapeError: the shapes differ, or are neither (H, W) nor (N,).
        DTypeError: labels are no integers, ``ignore`` is not bool, or the tolerance is no number.
        ConfigError: the tolerance is not finite and above 0.
    """
    _check(predicted, true, ignore)
    tolerance = checked_positive("score_segmentation", "tolerance", {"tolerance": tolerance})
    guess, truth = (labels.detach().cpu().numpy().astype(np.int64) for labels in (predicted, true))
    if ignore is not None:
        blank = ignore.detach().cpu().numpy()
        guess, truth = np.where(blank, -1, guess), np.where(blank, -1, truth)
    # Row 0 and column 0 are the background.
    guess_ids, guess_number = _numbered(guess)
    truth_ids, truth_number = _numbered(truth)
    shape = (len(truth_ids) + 1, len(guess_ids) + 1)
    table = np.bincount((truth_number * shape[1] + guess_number).ravel(), minlength=shape[0] * shape[1]).reshape(shape)
    both, true_size, guess_size = table[1:, 1:], table[1:].sum(1), table[:, 1:].sum(0)
    f = 2.0 * both / (true_size[:, None] + guess_size[None])
    pairs = _assigned(f)
    shared = sum(int(both[i, j]) for i, j in pairs)
    precision, recall = _part(shared, int(guess_size.sum())), _part(shared, int(true_size.sum()))
    chosen = dict(pairs)
    best = (both / (true_size[:, None] + guess_size[None] - both)).max(1, initial=0.0)
    objects = []
    for i, label in enumerate(truth_ids.tolist()):
        j = chosen.get(i)
        objects.append(
            ObjectScore(
                label=label,
                predicted=None if j is None else int(guess_ids[j]),
                f=0.0 if j is None else float(f[i, j]),
                iou=float(best[i]),
            )
        )
    edges: tuple[float | None, float | None] = (None, None)
    if truth.ndim == 2:
        edges = _boundary_scores(guess_number, truth_number, shape, pairs, _pixels(tolerance, truth.shape))
    return SegmentationScores(
        overlap_precision=precision,
        overlap_recall=recall,
        overlap_f=_harmonic(precision, recall),
        boundary_precision=edges[0],
        boundary_recall=edges[1],
        boundary_f=None if edges[0] is None or edges[1] is None else _harmonic(edges[0], edges[1]),
        found=_part(sum(one.f > FOUND_ABOVE for one in objects), len(objects)),
        mean_iou=math.fsum(one.iou for one in objects) / len(objects) if objects else 1.0,
        num_predicted=len(guess_ids),
        objects=tuple(objects),
    )


SCORES = (
    "overlap_precision",
    "overlap_recall",
    "overlap_f",
    "boundary_precision",
    "boundary_recall",
    "boundary_f",
    "found",
    "mean_iou",
)


def mean_scores(scores: Sequence[SegmentationScores]) -> dict[str, float | None]:
    """Average every score over images, each counting the same; None where an image has none.

    Raises:
        ConfigError: there is no image.
    """
    if not scores:
        raise ConfigError("mean_scores: there is nothing to average; give the scores of one image at least")
    means: dict[str, float | None] = {}
    for name in SCORES:
        values = [getattr(one, name) for one in scores]
        means[name] = None if any(value is None for value in values) else math.fsum(values) / len(values)
    return means


def _check(predicted: Tensor, true: Tensor, ignore: Tensor | None) -> None:
    where = "score_segmentation"
    given: dict[str, Any] = {"predicted": predicted, "true": true, "ignore": ignore}
    for name, value in given.items():
        if value is None and name == "ignore":
            continue
        wanted = "bool" if name == "ignore" else "integers"
        is_right = isinstance(value, Tensor) and (
            value.dtype is torch.bool
            if name == "ignore"
            else not (value.dtype is torch.bool or value.dtype.is_floating_point or value.dtype.is_complex)
        )
        if not is_right:
            kind = value.dtype if isinstance(value, Tensor) else type(value).__name__
            raise DTypeError(f"{where}: {name} must be a tensor of {wanted}, got {kind}")
        if value.ndim not in (1, 2):
            raise ShapeError(f"{where}: {name} must be an image (H, W) or rows (N,), got {tuple(value.shape)}")
        if value.shape != true.shape:
            raise ShapeError(
                f"{where}: {name} is {tuple(value.shape)} but true is {tuple(true.shape)}; labels are compared pixel "
                "by pixel, so bring both to the same image"
            )


def _numbered(labels: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the labels of objects in rising order, and the image of their numbers 1, 2, ...; 0 = none."""
    if labels.max(initial=-1) < labels.size:  # counted in a fraction of the time that sorting takes
        place = np.maximum(labels, -1) + 1
        is_there = np.bincount(place.ravel(), minlength=1) > 0
        is_there[0] = False
        return np.flatnonzero(is_there) - 1, np.where(is_there, is_there.cumsum(), 0)[place]
    ids, number = np.unique(labels, return_inverse=True)
    first = int((ids < 0).sum())
    return ids[first:], np.maximum(number.reshape(labels.shape) + 1 - first, 0)


def _assigned(f: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return the pairs (true, predicted) of the one-to-one assignment with the largest sum; those that overlap."""
    from scipy.optimize import linear_sum_assignment  # imported late: only this function needs it

    rows, columns = linear_sum_assignment(f, maximize=True)
    return [(int(i), int(j)) for i, j in zip(rows, columns) if f[i, j] > 0]


def _boundary_scores(
    guess: NDArray[np.int64],
    truth: NDArray[np.int64],
    shape: tuple[int, int],
    pairs: Sequence[tuple[int, int]],
    reach: int,
) -> tuple[float, float]:
    """Return precision and recall of the boundaries of assigned objects, over those of all."""
    edges = [[_boundary(image == number) for number in range(1, count)] for image, count in zip((truth, guess), shape)]
    true_edges, guess_edges = edges
    near_true = near_guess = 0
    for i, j in pairs:
        near_true += _num_near(guess_edges[j], true_edges[i], reach)
        near_guess += _num_near(true_edges[i], guess_edges[j], reach)
    totals = [sum(int(edge.sum()) for edge in some) for some in (guess_edges, true_edges)]
    return _part(near_true, totals[0]), _part(near_guess, totals[1])


def _boundary(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark the pixels that differ from their right, lower or lower right neighbor; beyond the image nothing differs."""
    edge = np.zeros_like(mask)
    edge[:, :-1] = mask[:, :-1] ^ mask[:, 1:]
    edge[:-1] |= mask[:-1] ^ mask[1:]
    edge[:-1, :-1] |= mask[:-1, :-1] ^ mask[1:, 1:]
    return edge


def _num_near(edge: NDArray[np.bool_], other: NDArray[np.bool_], reach: int) -> int:
    """Count the pixels of an edge that lie within ``reach`` pixels of the other."""
    from scipy.spatial import cKDTree  # imported late: only this function needs it

    pixels, targets = (np.column_stack(np.divmod(np.flatnonzero(one), one.shape[1])) for one in (edge, other))
    if not len(pixels) or not len(targets):
        return 0
    distance, _ = cKDTree(targets).query(pixels)
    return int((distance <= reach + 1e-6).sum())  # distances are roots of whole numbers


def _pixels(tolerance: float, size: tuple[int, ...]) -> int:
    return math.ceil(tolerance) if tolerance >= 1 else math.ceil(tolerance * math.hypot(*size))


def _part(some: int, all_: int) -> float:
    return some / all_ if all_ else 1.0


def _harmonic(a: float, b: float) -> float:
    return 2 * a * b / (a + b) if a + b else 0.0


__all__ = ["FOUND_ABOVE", "SCORES", "ObjectScore", "SegmentationScores", "mean_scores", "score_segmentation"]
