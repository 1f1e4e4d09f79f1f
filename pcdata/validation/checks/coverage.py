"""Is there depth at all, and where is it missing?"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pcdata.structures import DepthFrame, PointCloud
from pcdata.validation.capture_check import register_check
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.measures.missing_region import largest_missing_block, largest_missing_region
from pcdata.verdicts import Finding, graded

_RAISE = (
    "raise the exposure or the projector's power, turn away from windows and mirrors, keep to the sensor's range, or "
    "drop the capture"
)
_ONE_PIECE = "one region explains it: right where the background was cut away on purpose; else "


@register_check(
    "Is there depth at all, and where is it missing?",
    findings={
        "valid_fraction": (
            "pixels with a reading / all pixels",
            "{0.valid_fraction[0]:.1%}",
            "below {0.valid_fraction[1]:.1%}",
            "200,000 and 100,000 of 640x480, as fractions for every resolution",
        ),
        "missing_region": (
            "largest connected region without readings / image, by cells of 1/32 of the longer side; says where",
            "{0.missing_region[0]:.1%}",
            "above {0.missing_region[1]:.1%}, more than {0.missing_region[0]:.1%} of it whole rows or columns that end "
            "straight",
            "one region may not miss what all holes together may (1 - {0.valid_fraction[0]:.1%}); half of that is "
            "worth a look. An image stored in part ends at a full line; around a background that was cut away, or a "
            "hand before the lens, the first lines hold tips, and that only warns. Clouds only warn",
        ),
    },
    of=(DepthFrame, PointCloud),
)
def coverage(capture: DepthFrame | PointCloud, limits: CaptureLimits, before: Sequence[Finding]) -> list[Finding]:
    """Judge every view, or a cloud whose rows are the pixels of an image."""
    if isinstance(capture, DepthFrame):
        views = [_coverage_of(depth > 0, limits, view) for view, depth in enumerate(capture.depth)]
        return [finding for view in views for finding in view]
    if not capture.num_points:
        return [
            graded(
                "valid_fraction",
                0.0,
                limits=limits.valid_fraction,
                at_least=True,
                found="the cloud has no points",
                advice="drop it, or look at the step or the program that left nothing",
            )
        ]
    size = capture.meta[0].get("organized_size")
    if size is None or capture.source_index is None:
        return []
    valid = torch.zeros(size[0] * size[1], dtype=torch.bool, device=capture.device)
    valid[capture.source_index] = True
    return _coverage_of(valid.view(size[0], size[1]), limits, may_be_cut=True)


def _coverage_of(
    valid: Tensor,  # (H, W) bool, True = has a reading
    limits: CaptureLimits,
    view: int | None = None,
    *,
    may_be_cut: bool = False,
) -> list[Finding]:
    """Judge the share of pixels that have a reading, and the largest region that has none.

    A region without straight ends only warns: someone may have taken the background away on purpose, or something stood
    before the lens. With ``may_be_cut`` every one only warns: straight cuts may be on purpose too.
    """
    height, width = valid.shape
    count = int(valid.sum())
    fraction = count / valid.numel()
    missing, box = largest_missing_region(valid)
    where = place_in_words(box, (height, width))
    # At least half of what may not be missing lies in whole lines: less is a sensor's blind border.
    is_block = largest_missing_block(valid) > limits.missing_region[0]
    return [
        graded(
            "valid_fraction",
            fraction,
            limits=limits.valid_fraction,
            at_least=True,
            found=f"{count:,} of {valid.numel():,} pixels have a reading",
            advice=_ONE_PIECE + _RAISE if fraction + missing >= limits.valid_fraction[0] else _RAISE,
            view=view,
        ),
        graded(
            "missing_region",
            missing,
            limits=(limits.missing_region[0], limits.missing_region[1] if is_block and not may_be_cut else None),
            found=f"{100 * missing:.0f} % of the image in one piece have no reading, {where}"
            if missing
            else "no region without readings",
            advice=f"whole lines have no reading {where}: the background was cut away, the scene is out of range, "
            "or a part of the image was not stored; compare with the color image before you drop it"
            if is_block
            else f"look at what the camera sees {where}: something before the lens, out of range, black, shiny or "
            "transparent; right if the background was cut away on purpose",
            view=view,
        ),
    ]


def place_in_words(box: tuple[int, int, int, int], size: tuple[int, int]) -> str:
    """Say where in an image of (height, width) a box (top, left, bottom, right) lies, e.g. ``at the top left``."""
    vertical = _part(box[0] / size[0], box[2] / size[0], "top", "bottom")
    horizontal = _part(box[1] / size[1], box[3] / size[1], "left", "right")
    words = [word for word in dict.fromkeys((vertical, horizontal)) if word]
    return f"at the {' '.join(words)}" if words else "all over the image"


def _part(begin: float, end: float, low: str, high: str) -> str:
    if begin < 0.1 and end > 0.9:
        return ""
    middle = (begin + end) / 2
    return low if middle < 0.4 else high if middle > 0.6 else "middle"
