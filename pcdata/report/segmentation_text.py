"""Tables of how well objects were told apart."""

from __future__ import annotations

from collections.abc import Mapping

from pcdata.report.plain_table import text_table
from pcdata.validation.segmentation import FOUND_ABOVE, SCORES, SegmentationScores, mean_scores

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
            lines.append(f"not found in {name}: {', '.join(lost)}")
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
