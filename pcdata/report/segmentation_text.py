"""Tables of how well objects were told apart."""

from __future__ import annotations

from collections.abc import Mapping

from pcdata.report.plain_table import text_table
from pcdata.validation.segmentation import FOUND_ABOVE, SCORES, SegmentationScores, mean_scores

_SHOWN = 10  # lost objects of one scene; the rest is counted
_MOST = 1000  # objects in one image, above which its numbers are hardly labels
_HEADERS = ("overlap P", "R", "F", "boundary P", "R", "F", "found", "mIoU")


def segmentation_text(scores: Mapping[str, SegmentationScores]) -> str:
    """Write a row for every image and one of their means, and name the objects that were not found."""
    rows: list[list[object]] = [
        [name, len(one.objects), one.num_predicted, *(_number(getattr(one, score)) for score in SCORES)]
        for name, one in scores.items()
    ]
    means = mean_scores([*scores.values()])
    total = [sum(len(one.objects) for one in scores.values()), sum(one.num_predicted for one in scores.values())]
    rows.append(["mean", *total, *(_number(means[score]) for score in SCORES)])
    lines = [text_table(("scene", "objects", "predicted", *_HEADERS), rows)]
    for name, one in scores.items():
        lost = [f"{item.label} ({item.f:.2f})" for item in one.objects if item.f <= FOUND_ABOVE]
        if lost:
            more = f" and {len(lost) - _SHOWN} more" if len(lost) > _SHOWN else ""
            lines.append(f"not found in {name}: {', '.join(lost[:_SHOWN])}{more}")
    return "\n".join([*lines, *_doubts(scores)])


def _doubts(scores: Mapping[str, SegmentationScores]) -> list[str]:
    """Say what scores such as these are most often: a mistake in what was compared."""
    told = []
    if not any(one.objects for one in scores.values()):
        told.append(
            "note  no scene has a true object, so that found and mIoU are 1 of nothing: are --true-background, "
            "--true-parts and the order of the two paths right?"
        )
    for name, one in scores.items():
        for count, whose in ((one.num_predicted, "predicted"), (len(one.objects), "true")):
            if count > _MOST:
                told.append(f"note  {name} has {count:,} {whose} objects: is this an image of depth instead of labels?")
                return told
    return told


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
