"""The families that carry most steps: those that move clouds, that choose rows, that remove points or readings."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.errors import PcdataWarning, ReplayError, TooFewPointsError
from pcdata.functional.fixed_rows import FixedRows, move_kept
from pcdata.functional.rows import KeptRows, kept_rows
from pcdata.rng import Streams
from pcdata.structures import DepthFrame, PointCloud
from pcdata.transforms.base import Params, Transform, sample_name
from pcdata.transforms.decisions import TOLD_ROWS, Decisions
from pcdata.transforms.field_types import Fraction

GEOMETRY = ("points", "source_index", "viewpoint")  # where points lie, on which pixels, and what saw them


class LeftOutWarning(PcdataWarning):
    """A step left out what may be wanted."""


class SpatialTransform(Transform, abstract=True):
    """A step that moves every cloud by one 4x4: write ``make_params`` returning ``{"matrix": (B, 4, 4)}``."""

    def repeat(self, data: PointCloud, decided: Decisions) -> Params:
        """The motion, wherever the cloud lies."""
        matrix = decided.values("matrix", like=torch.empty(0, 4, 4, dtype=torch.float64, device="cpu"))
        if not bool((torch.linalg.det(matrix) != 0).all()):
            raise ReplayError(f"{type(self).__name__}: the history tells a matrix that has no inverse")
        return {"matrix": matrix}

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Move the cloud; the frame and the unit follow :meth:`frame_after` and :meth:`unit_given`."""
        return data.transformed(params["matrix"], frame_id=self.frame_after(data.frame_id), unit=self.unit_given())


class SelectTransform(Transform, abstract=True):
    """A step that keeps some rows, possibly repeated or reordered within their cloud: write ``pick``."""

    def decides_within(self, share: float) -> bool:
        """Say whether the step can decide among so large a part of a cloud's rows, as they lie: ``params_within``."""
        return False

    def params_within(self, data: PointCloud, within: Tensor, ptr: Tensor) -> Params:
        """Decide what stays of the rows that a (N,) bool mask has, as if they were all; ``index`` is of all rows.

        Row pointers are those of the rows that the mask has.
        """
        raise NotImplementedError(f"{type(self).__name__}: write the method params_within(self, data, within, ptr)")

    def looks_at(self) -> Collection[str] | None:
        """The per-point fields that picking looks at, ``source_index`` for the image; None = it may look at any."""
        return None

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor] | Params:
        """Return ``index`` (M,) int64, or a (N,) bool mask, of the rows to keep, and the result's ``ptr`` (B+1,).

        Or, of a mask, what :func:`kept_params` makes of it: the checksums of the history then cost no second look.
        """
        raise NotImplementedError(f"{type(self).__name__}: write the method pick(self, cloud, streams)")

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Decide which rows stay."""
        picked = self.pick(data, streams)
        return picked if isinstance(picked, dict) else dict(zip(("index", "ptr"), picked))

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Pick the rows of every field."""
        return self.with_facts(data.select(params["index"], params["ptr"]), data, params)

    def with_facts(self, result: PointCloud, data: PointCloud, params: Params) -> PointCloud:
        """Return the result with what was found out about the data beside the rows: nothing."""
        return result


class DropLimit(Transform, abstract=True):
    """A step that removes points, or readings of depth images, and says when it removes more than is meant.

    Args:
        max_drop: largest part of a cloud's points, or of a view's readings, that it may remove; None = no limit, but
            that a cloud keeps a point.
        drop_alarm: what it does where it removes more.

    Raises:
        TooFewPointsError: it removes more of a cloud or a view, and the alarm is an error.

    Warns:
        LeftOutWarning: it removes more of a cloud or a view, and the alarm is a warning.
    """

    max_drop: Fraction | None = None
    drop_alarm: Literal["error", "warn"] = "error"

    def recorded_counts(
        self, result: PointCloud, before: list[int] | None, after: list[int], params: Params, **told: Any
    ) -> PointCloud:
        """Hold the points to the limit before the step is recorded."""
        if self.max_drop is not None:
            self.check_drop(before or [], after, lambda b: f"points of cloud {b}{sample_name(result, b)}")
        return super().recorded_counts(result, before, after, params, **told)

    def _identity(self) -> Any:
        name, version, fields = super()._identity()
        if self.max_drop is None and self.drop_alarm == "error":  # what is stored is that of a step without a limit
            fields = {field: value for field, value in fields.items() if field not in ("max_drop", "drop_alarm")}
        return [name, version, fields]

    def check_drop(self, before: list[int], after: list[int], of: Callable[[int], str]) -> None:
        """Hold what is left of each cloud or view to the limit; ``of`` says what is counted there."""
        for b, (had, count) in enumerate(zip(before, after)):
            if self.max_drop is None or had - count <= self.max_drop * had:
                continue
            text = (
                f"{type(self).__name__}: {had - count} of the {had} {of(b)} are removed, {(had - count) / had:.1%}, "
                f"more than max_drop={self.max_drop:g}; look at its fields, or at the capture"
            )
            if self.drop_alarm == "error":
                raise TooFewPointsError(text)
            warnings.warn(text, LeftOutWarning, stacklevel=2)


def kept_params(marks: Tensor, ptr: Tensor, *, gone: bool = False, within: Tensor | None = None) -> Params:
    """Return the params of a selection that keeps the rows that are marked, or with ``gone`` those that are not.

    Of the rows ``within`` alone, if that is given.
    """
    return params_of(kept_rows(marks, ptr, gone=gone, within=within))


def params_of(kept: KeptRows) -> Params:
    """Return the params of a selection that keeps such rows."""
    params = {"index": kept.keep, "ptr": kept.ptr}
    return params if kept.sums is None else {**params, TOLD_ROWS: kept.sums}


class RemoveTransform(DropLimit, SelectTransform, abstract=True):
    """A step that removes rows: write ``pick``."""

    def fixed_keep(self, like: FixedRows) -> Callable[[FixedRows], Tensor] | None:
        """Return what marks the rows to keep as :meth:`fixed_work` does, (C,) bool; behind the last row anything."""
        return None

    def fixed_work(self, like: FixedRows) -> Callable[[FixedRows], FixedRows] | None:
        """Mark, and move what is kept together."""
        mark = self.fixed_keep(like)
        if mark is None or like.normals is not None:
            return None

        def work(rows: FixedRows) -> FixedRows:
            keep = mark(rows)
            return FixedRows(*move_kept(rows.points, rows.source_index, rows.ptr, keep), rows.viewpoint, keep)

        return work


class MaskTransform(DropLimit, abstract=True):
    """A step that blanks readings of depth images, or cuts them off."""

    takes = DepthFrame
    gives = DepthFrame

    def recorded(
        self, data: DepthFrame, result: DepthFrame, params: Params, drawn: NDArray[np.int64] | None = None
    ) -> Any:
        """Hold the readings to the limit before the step is recorded."""
        if self.max_drop is not None:
            before, after = ((frame.depth > 0).flatten(1).sum(1).tolist() for frame in (data, result))
            sample = f" (sample {data.sample_id!r})" if data.sample_id else ""
            self.check_drop(before, after, lambda view: f"readings of view {view}{sample}")
        return super().recorded(data, result, params, drawn)
