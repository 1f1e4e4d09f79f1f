"""How much a step may remove: one rule for all that drop points."""

from __future__ import annotations

import warnings
from typing import Literal

from pcdata.errors import PcdataWarning, TooFewPointsError
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params, Transform, sample_name
from pcdata.transforms.families import SelectTransform
from pcdata.transforms.field_types import Fraction


class LeftOutWarning(PcdataWarning):
    """A step left out what may be wanted."""


class DropLimit(Transform, abstract=True):
    """A step that removes points, and says when it removes more than is meant.

    Args:
        max_drop: largest part of a cloud's points that it may remove; None = all but the last.
        drop_alarm: what it does where it removes more.

    Raises:
        TooFewPointsError: it removes more of a cloud, and the alarm is an error.

    Warns:
        LeftOutWarning: it removes more of a cloud, and the alarm is a warning.
    """

    max_drop: Fraction | None = None
    drop_alarm: Literal["error", "warn"] = "error"

    def recorded_counts(
        self, result: PointCloud, before: list[int] | None, after: list[int], params: Params
    ) -> PointCloud:
        """Hold the counts to the limit before they are recorded."""
        for b, (had, count) in enumerate(zip(before or [], after)):
            if self.max_drop is None or had - count <= self.max_drop * had:
                continue
            text = (
                f"{type(self).__name__}: {had - count} of the {had} points of cloud {b}{sample_name(result, b)} are "
                f"removed, {(had - count) / had:.1%}, more than max_drop={self.max_drop:g}; look at its fields, or at "
                "the capture"
            )
            if self.drop_alarm == "error":
                raise TooFewPointsError(text)
            warnings.warn(text, LeftOutWarning, stacklevel=2)
        return super().recorded_counts(result, before, after, params)


class RemoveTransform(DropLimit, SelectTransform, abstract=True):
    """A step that removes rows: write ``pick``."""
