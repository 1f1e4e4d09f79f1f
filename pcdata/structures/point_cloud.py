"""The one cloud type: B >= 1 packed clouds that know their frame, their unit and their source."""

from __future__ import annotations

import itertools
import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from pcdata.contracts.known import FINITE, is_known, note
from pcdata.contracts.on_host import bounds_of, counts_of, hold, read_together, taken, uploaded
from pcdata.contracts.tensors import check_ptr_values, check_tensors
from pcdata.errors import DTypeError, ShapeError
from pcdata.functional.image_grid import ImageGrid, pixels_rise
from pcdata.functional.motions import are_plain_motions
from pcdata.functional.rows import cloud_of_rows, join_rows, pad_rows, pick_rows, ptr_from_counts, rows_of_mask
from pcdata.geometry.rigid import check_affine
from pcdata.structures.cloud_batch import CloudBatch, joined_facts
from pcdata.structures.cloud_checks import check_cloud, check_fields, check_motions
from pcdata.structures.cloud_summary import cloud_summary
from pcdata.structures.image_layout import pixels_of_views, within_image
from pcdata.structures.joining import joinable_parts, rows_per_cloud
from pcdata.structures.kinds import FIELDS, METRE, Kind, attributes, averaged, fillers, moved, present_fields
from pcdata.structures.padded import PaddedClouds, padded_clouds
from pcdata.structures.point_arrays import attributes_of_arrays
from pcdata.structures.read_later import Histories, MadeWhenRead, Metas, OfClouds, Step
from pcdata.structures.showing import shown_page
from pcdata.structures.signals import told_signals
from pcdata.structures.structure import checked_copy, derived
from pcdata.structures.unbatched import Unbatched

_FEW_MOTIONS = 4  # so many are looked at sooner than the core is called
_SELECTED = {"points": "N 3", "ptr": "ptr N B"}


@dataclass(frozen=True, eq=False, kw_only=True)
class PointCloud(CloudBatch):
    """B >= 1 point clouds in one coordinate frame, packed: cloud b is rows ``ptr[b]:ptr[b+1]`` and may be empty.

    Frozen: every method returns a new cloud and shares what did not change. Coordinates are multiplied by a matrix only
    in :meth:`transformed`, rows are picked only in :meth:`select`, so no field can be left behind.

    Args:
        points: (N, 3) float32, metres in frame_id unless unit says "normalized".
        ptr: (B+1,) int64; None = one cloud.
        colors: (N, 3) float32 RGB in [0, 1].
        normals: (N, 3) float32, unit length.
        labels: (N,) int64 object / segment id, -1 = none.
        source_index: (N,) int64: flat pixel v*H*W + row*W + column, or row of the source file.
        extra: name -> (N, ...), each of a kind that ``kinds`` names.
    """

    points: Tensor
    ptr: Tensor = None  # type: ignore[assignment]
    colors: Tensor | None = None
    normals: Tensor | None = None
    labels: Tensor | None = None
    source_index: Tensor | None = None
    extra: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        given: Any = self.source_from_cloud  # whatever the annotation promises
        self._fill_defaults()
        check_cloud(self, {name: getattr(self, name) for name in FIELDS}, self.extra, self.ptr)
        if self.ptr.device.type == "cpu":  # values elsewhere would have to be waited for
            motions = dict(self.frames) if given is None else {"source_from_cloud": given, **self.frames}
            check_motions("PointCloud", motions)

    # -- construction ----------------------------------------------------------------------------------------------

    def _fill_defaults(self) -> None:
        fill = object.__setattr__  # the class is frozen
        given: dict[str, Any] = vars(self)  # as the caller left it, whatever the annotations promise
        if not isinstance(given["points"], Tensor):
            found = type(given["points"]).__name__
            raise DTypeError(f"PointCloud: points must be a torch.Tensor, float32 (N, 3), not {found}")
        if given["ptr"] is None:
            fill(self, "ptr", ptr_from_counts([len(self.points)], self.points.device))
        num_clouds = len(self.ptr) - 1
        if given["source_from_cloud"] is None:
            identity = torch.eye(4, dtype=torch.float64, device="cpu").repeat(num_clouds, 1, 1)
            fill(self, "source_from_cloud", uploaded(identity, self.device))
        fill(self, "source_frame", self.source_frame or self.frame_id)
        if not isinstance(given["meta"], Metas):
            fill(self, "meta", tuple(given["meta"]) or tuple([{} for _ in range(num_clouds)]))
        if not isinstance(given["history"], Histories):
            fill(self, "history", tuple(map(tuple, given["history"])) or ((),) * num_clouds)
        fill(self, "kinds", dict(zip(self.kinds, map(Kind, self.kinds.values()))))

    @classmethod
    def from_numpy(
        cls,
        points: ArrayLike,  # (N, 3)
        *,
        frame_id: str,  # the frame of the coordinates, e.g. "base"
        metres_per_unit: float | None = None,  # of all lengths, e.g. 0.001; None = floats that look like metres
        unit: str = METRE,  # "normalized" for coordinates that are no lengths
        ptr: ArrayLike | None = None,  # (B+1,) row pointers; None = one cloud
        viewpoint: ArrayLike | None = None,  # (3,) or (B, 3) where the sensor stood, or (N, 3) for every point
        kinds: Mapping[str, Kind | str] | None = None,  # of the fields of your own
        **fields: ArrayLike | None,  # colors, normals, labels, source_index and fields of your own, N rows each
    ) -> PointCloud:
        """Make a cloud, or a batch, of arrays in memory; all are copied.

        Colors are whole numbers up to 255 or floats in 0..1, RGB; labels whole numbers, -1 = none; normals get unit
        length, NaN ones the zero vector. ``PointCloud.from_numpy(**cloud.numpy(), frame_id=..., kinds=..., unit=...)``
        with what the cloud says of itself gives its points back as they were.

        Raises:
            UnitError: whole numbers without a unit, or coordinates that do not look like metres.
            NonFiniteError: points that are NaN or infinite.
            DTypeError: an array of something else than numbers, or a field whose kind nobody states.
            ShapeError: arrays of different numbers of rows.
            CaptureError: colors, labels or coordinates that cannot be meant.
        """
        given = {"points": points, "ptr": ptr, "viewpoint": viewpoint, **fields}
        return cls(
            frame_id=frame_id,
            unit=unit,
            **attributes_of_arrays("PointCloud.from_numpy", given, kinds or {}, metres_per_unit, unit),
        )

    def numpy(self) -> dict[str, NDArray[Any]]:
        """Return ``ptr``, ``viewpoint`` and every per-point field that is there as arrays by name.

        In host memory they share the memory of the cloud: copy what is to be changed.
        """
        fields = {**self.fields(), "ptr": self.ptr}
        if self.viewpoint is not None and "viewpoint" not in fields:
            fields["viewpoint"] = self.viewpoint
        return {name: value.detach().cpu().numpy() for name, value in fields.items()}

    # -- reading ---------------------------------------------------------------------------------------------------

    @property
    def num_points(self) -> int:
        """The number of points N of all clouds together."""
        return self.points.shape[0]

    @property
    def counts(self) -> Tensor:
        """(B,) int64 points per cloud."""
        return self.ptr[1:] - self.ptr[:-1]

    @property
    def device(self) -> torch.device:
        """Where the points lie."""
        return self.points.device

    def fields(self) -> dict[str, Tensor]:
        """Return every per-point field that is present, by name; extra fields included."""
        return present_fields(self)

    def image_grid(self) -> ImageGrid | None:
        """Where the points sit in their depth images, for the operations' ``grid=``; None once they left them."""
        if self.layout is None or self.source_index is None:
            return None
        return ImageGrid(
            within_image(self.source_index, self.ptr, self.layout.size),
            self.layout.size,
            self.layout.intrinsics,
            self.source_from_cloud,
        )

    def viewpoint_per_point(self) -> Tensor | None:
        """(N, 3): where the sensor stood that saw each point, or None when unknown."""
        if "viewpoint" in self.extra:
            return self.extra["viewpoint"]
        return None if self.viewpoint is None else self.viewpoint[cloud_of_rows(self.ptr)]

    # -- changing --------------------------------------------------------------------------------------------------

    def with_fields(self, **values: Tensor | None) -> PointCloud:
        """Replace, add or (None) drop per-point fields of unchanged rows; new extra fields need :meth:`with_extra`."""
        core = {name: value for name, value in values.items() if name in FIELDS}
        if len(core) == len(values) and "points" not in core:  # the others stay what they are, and fit
            check_fields({**{name: vars(self)[name] for name in FIELDS}, **core}, self.ptr)
            return derived(self, **core, layout=None if "source_index" in core else self.layout)
        extra = dict(self.extra)
        for name in values.keys() - core.keys():
            value = values[name]
            if name not in extra:
                raise DTypeError(f"PointCloud.with_fields: no field {name!r}; add it by with_extra(name, value, kind)")
            if value is None:
                del extra[name]
            else:
                extra[name] = value
        kinds = {name: kind for name, kind in self.kinds.items() if name in extra}
        layout = None if {"points", "source_index"} & values.keys() else self.layout
        return checked_copy(self, **core, extra=extra, kinds=kinds, layout=layout)

    def with_extra(self, name: str, value: Tensor, kind: Kind | str) -> PointCloud:
        """Add or replace one extra per-point field of the given kind."""
        return checked_copy(self, extra={**self.extra, name: value}, kinds={**self.kinds, name: Kind(kind)})

    def with_meta(self, entries: Sequence[Mapping[str, Any]] | MadeWhenRead) -> PointCloud:
        """Merge one mapping of JSON-able findings into the meta of each cloud.

        Raises:
            ValueError: there is not one mapping for each cloud.
        """
        held = vars(self)["meta"]
        if isinstance(entries, MadeWhenRead) and len(entries) == len(held):
            return derived(self, meta=(held if isinstance(held, Metas) else Metas([held])).then(entries))
        if isinstance(held, Metas) and len(entries) == len(held):
            return derived(self, meta=held.then([*map(dict, entries)]))
        return derived(self, meta=tuple([{**old, **new} for old, new in zip(held, entries, strict=True)]))

    def with_steps(self, steps: Sequence[Step] | OfClouds) -> PointCloud:
        """Add one JSON-able step to the history of each cloud.

        Raises:
            ShapeError: there is not one step for each cloud.
        """
        held = vars(self)["history"]
        if len(steps) != len(held):
            raise ShapeError(f"PointCloud.with_steps: takes a step of each of {len(held)} clouds, got {len(steps)}")
        return derived(self, history=(held if isinstance(held, Histories) else Histories([held])).then(steps))

    def select(self, index: Tensor, ptr: Tensor) -> PointCloud:
        """Keep the rows ``index`` (M,) int64, or a (N,) bool mask, of every per-point field; ``ptr`` cuts the result.

        Rows of a cloud must stay within that cloud. A mask keeps their order, and so the image they lie on.

        Raises:
            ShapeError: index has other than one dimension, or ptr (B+1,) int64 does not cut the M rows into B clouds.
        """
        given = {"points": self.points, "ptr": ptr}
        sizes = check_tensors("PointCloud", given, _SELECTED, check_values=False)
        if sizes["B"] != self.num_clouds:
            raise ShapeError(f"PointCloud.select: ptr cuts {sizes['B']} clouds out of {self.num_clouds}")
        is_mask, count = index.dtype is torch.bool, None
        if index.ndim != 1:
            raise ShapeError(
                f"PointCloud.select: index must be rows (M,) or a mask (N,), got shape {tuple(index.shape)}"
            )
        if is_mask and self.device.type == "cpu":
            count = min(max(bounds_of(ptr)[-1], 0), self.points.shape[0])  # if ptr is wrong, that is told below
        elif is_mask and index.shape == (self.num_points,):
            (found,), bounds = read_together([index.sum(), ptr])
            hold(ptr, torch.tensor(bounds, dtype=ptr.dtype, device="cpu"))
            index = rows_of_mask(index, found)
        rows = pick_rows(self.fields(), index, count=count)
        check_ptr_values("PointCloud", "ptr", ptr, rows["points"].shape[0])
        layout = self.layout if is_mask else None
        if is_known(FINITE, self.points):
            note(FINITE, rows["points"])
        if layout is not None and "source_index" in rows:
            for fact in (pixels_rise(layout.size), pixels_of_views(layout.size)):
                if is_known(fact, vars(self)["source_index"], self.ptr):
                    note(fact, rows["source_index"], ptr)
        return self._with_rows(rows, ptr=ptr, layout=layout)

    def parted(self, index: Tensor, ptr: Tensor, clouds: Tensor) -> PointCloud:
        """Make M clouds of rows (K,) int64, cut by ``ptr`` (M+1,): those of one are rows of cloud ``clouds[m]``."""
        rows = pick_rows(self.fields(), index)
        if is_known(FINITE, self.points):
            note(FINITE, rows["points"])
        return self._with_rows(rows, ptr=ptr, **self._facts_repeated(clouds))

    def _with_rows(self, rows: Mapping[str, Tensor], **others: Any) -> PointCloud:
        """Replace all per-point fields at once, and any other attributes, by ones that are known to fit."""
        return derived(self, **attributes(rows), **others)

    def with_rows(self, fields: Mapping[str, Tensor], ptr: Tensor) -> PointCloud:
        """Replace the rows of all fields at once: the same fields of other rows, cut by ``ptr`` into as many clouds."""
        return self._with_rows(fields, ptr=ptr, layout=None)

    def averaged(
        self, group: Tensor, ptr: Tensor, *, points: Tensor, reduce: Mapping[str, str | Tensor] | None = None
    ) -> PointCloud:
        """Replace the rows of every group by one row: each field's average, as its kind says.

        Args:
            group: (N,) int64, the group of each row; groups lie within a cloud and none is empty.
            ptr: (B+1,) int64, which groups are whose.
            points: (G, 3) float32, the points that stand for the groups.
            reduce: instead, by field: "mean", "vote", "first", "min" or "max" of its rows, or the row (G,) to take.

        Raises:
            DTypeError: a mean of integers, a vote among floats, or a field that the clouds do not have.
        """
        fields, reduce = self.fields(), reduce or {}
        if missing := reduce.keys() - fields.keys():
            raise DTypeError(f"PointCloud.averaged: no field {sorted(missing)}; the clouds have {sorted(fields)}")
        del fields["points"]
        rows = {}
        for name, value in fields.items():
            how = reduce.get(name)
            if isinstance(how, Tensor):
                rows[name] = value[how]
            else:
                rows[name] = averaged(name, value, self.kind(name), group, len(points), how)
        return self._with_rows({"points": points, **rows}, ptr=ptr, layout=None)

    def transformed(self, matrix: Tensor, *, frame_id: str | None = None, unit: str | None = None) -> PointCloud:
        """Move every positional and directional field by one affine (B, 4, 4) matrix per cloud.

        ``source_from_cloud`` absorbs the inverse, so it still leads back to the source.

        Args:
            matrix: new_from_old, (B, 4, 4) float64.
            frame_id: the frame the cloud is in afterwards; None = the frame keeps its name.
            unit: the unit afterwards; None = unchanged.

        Raises:
            ShapeError: there is not one matrix for each cloud.
            PoseError: a matrix is not affine (is it made for row vectors?), not finite, or singular.
        """
        matrices = self._checked_motions("PointCloud.transformed", matrix[None])
        first = matrices[0] if matrices.is_cpu else taken(matrices, 0)
        rows = moved(self.fields(), self.kinds, self.ptr, first)
        return self._with_rows(rows, **self._facts_moved(matrices, frame_id, unit))

    def with_facts_moved(self, matrices: Tensor) -> PointCloud:
        """Do what :meth:`transformed` does, by one matrix after another, but leave the points: the caller moves them.

        Args:
            matrices: new_from_old, (S, B, 4, 4) float64.

        Raises:
            ShapeError, PoseError: as :meth:`transformed`.
        """
        matrices = self._checked_motions("PointCloud.with_facts_moved", matrices)
        fields = self.fields()
        points = fields.pop("points")
        part_of = operator.getitem if matrices.is_cpu else taken
        for step in range(len(matrices)):
            fields = moved(fields, self.kinds, self.ptr, part_of(matrices, step)) if fields else {}
        return self._with_rows({"points": points, **fields}, **self._facts_moved(matrices, None, None))

    def _checked_motions(self, where: str, matrices: Tensor) -> Tensor:
        """Require affine matrices, (S, B, 4, 4), one for each cloud; return them as coordinates are multiplied."""
        if tuple(matrices.shape[1:]) != (self.num_clouds, 4, 4):
            raise ShapeError(f"{where}: matrix must be ({self.num_clouds}, 4, 4), {tuple(matrices.shape[1:])}")
        device = self.device
        if matrices.is_cpu and device.type != "cpu" and not matrices.requires_grad:
            wide = uploaded(matrices.to(torch.float64, copy=True), device)
        else:
            wide = matrices.to(dtype=torch.float64, device=device)
        if len(matrices) * self.num_clouds <= _FEW_MOTIONS or not are_plain_motions(
            wide.detach() if wide.requires_grad else wide
        ):
            for matrix in matrices:
                check_affine(where, matrix)
        return wide

    def in_source_frame(self) -> PointCloud:
        """Undo every spatial step: the same rows with coordinates in the source frame, in metres."""
        return self.transformed(self.source_from_cloud, frame_id=self.source_frame, unit=METRE)

    def to_frame(self, frame: str) -> PointCloud:
        """Return the same rows in another frame that the clouds know, in metres; the transform ToFrame records it too.

        Raises:
            FrameError: the clouds do not know the frame.
        """
        return self.transformed(self.frame_from_cloud(frame), frame_id=frame, unit=METRE)

    # -- batching --------------------------------------------------------------------------------------------------

    def __getitem__(self, which: int | slice) -> PointCloud:
        """Return one cloud of the batch, or a slice of it; the memory is shared."""
        return self._slice(self._which(which), bounds_of(self.ptr))

    def __iter__(self) -> Iterator[PointCloud]:
        bounds = bounds_of(self.ptr)
        return (self._slice(slice(b, b + 1), bounds) for b in range(self.num_clouds))

    def unbatch(self) -> list[PointCloud]:
        """Split into B single clouds (views of the same memory)."""
        return list(self)

    def _slice(self, clouds: slice, bounds: Sequence[int]) -> PointCloud:
        start, stop = bounds[clouds.start], bounds[clouds.stop]
        rows = {name: value[start:stop] for name, value in self.fields().items()}
        return self._with_rows(rows, ptr=self.ptr[clouds.start : clouds.stop + 1] - start, **self._facts_of(clouds))

    @staticmethod
    def cat(clouds: Sequence[PointCloud]) -> PointCloud:
        """Pack clouds (or batches) one after another into one batch.

        Raises:
            FrameError, UnitError: the clouds differ in frame, source frame or unit.
            ShapeError: the clouds carry different fields, or there are none.
            DeviceError: the clouds lie on different devices.
        """
        if isinstance(clouds, Unbatched):
            clouds = clouds.batches
            if len(clouds) == 1:
                return clouds[0]
        parts = joinable_parts(clouds, [cloud.fields() for cloud in clouds])
        ptr = ptr_from_counts(torch.cat([cloud.counts for cloud in clouds]))
        return clouds[0]._with_rows(join_rows(parts), ptr=ptr, **joined_facts(clouds))

    @staticmethod
    def from_padded(padded: PaddedClouds) -> PointCloud:
        """Return the packed clouds that were padded, as they were."""
        return PointCloud(
            ptr=ptr_from_counts(padded.counts),
            frame_id=padded.frame_id,
            unit=padded.unit,
            source_frame=padded.source_frame,
            kinds=padded.kinds,
            **attributes({name: value[padded.mask] for name, value in padded.fields().items()}),
            **padded._facts_of(slice(None)),
        )

    def padded(self, num_points: int | None = None) -> PaddedClouds:
        """Return (B, num_points, ...) tensors and the mask of real rows; padding is zero, and -1 for integers.

        Clouds of ``num_points`` each need no padding: then the tensors share the memory of this batch.

        Args:
            num_points: None = the largest count of the batch.

        Raises:
            ShapeError: a cloud is longer than ``num_points``.
        """
        counts = counts_of(self.ptr)
        if self.num_points == 0 or {*counts} != {counts[0] if num_points is None else num_points}:
            return self.cat_padded([self], num_points)
        shape = len(counts), counts[0]
        rows = {name: value.reshape(*shape, *value.shape[1:]) for name, value in self.fields().items()}
        return padded_clouds([self], rows, counts)

    @staticmethod
    def cat_padded(clouds: Sequence[PointCloud], num_points: int | None = None) -> PaddedClouds:
        """Return ``PointCloud.cat(clouds).padded(num_points)`` with every row copied once.

        Raises:
            FrameError, UnitError, ShapeError, DeviceError: as :meth:`cat` and :meth:`padded`.
        """
        if isinstance(clouds, Unbatched):
            clouds = clouds.batches
            if len(clouds) == 1:
                return clouds[0].padded(num_points)
        parts = joinable_parts(clouds, [cloud.fields() for cloud in clouds])
        counts = [counts_of(cloud.ptr) for cloud in clouds]
        flat = list(itertools.chain.from_iterable(counts))
        width = max(flat) if num_points is None else num_points
        if max(flat) > width:
            raise ShapeError(f"PointCloud.padded: a cloud has {max(flat)} points, more than num_points={width}")
        filler = fillers({name: values[0] for name, values in parts.items()}, clouds[0].kinds)
        rows = pad_rows({name: rows_per_cloud(value, counts) for name, value in parts.items()}, width, filler)
        return padded_clouds(clouds, rows, flat)

    def summary(self) -> str:
        """Say in some lines where the points are, how far apart, and what is known of each."""
        return cloud_summary(self)

    def show(self, *, max_points: int = 200_000, grasps: Tensor | None = None) -> Any:
        """Return a :class:`pcdata.report.Page` with the cloud in three dimensions: a notebook shows it.

        Args:
            max_points: drawn; of more every k-th is.
            grasps: (G, 4, 4) poses in this frame to be drawn, x between the fingers and z toward the object.
        """
        return shown_page([("cloud", self)], repr(self), max_points=max_points, grasps=grasps)

    def __repr__(self) -> str:
        counts = counts_of(self.ptr)
        sizes = f"{counts[0]} points" if len(counts) == 1 else f"{len(counts)} clouds of {min(counts)}-{max(counts)}"
        carried = ", ".join(name for name in self.fields() if name != "points")
        carried = f"{': ' + carried if carried else ''}{told_signals(self.recorded_signals)}"
        return f"PointCloud({sizes} in {self.frame_id!r} [{self.unit}]{carried})"
