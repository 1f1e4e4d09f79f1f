"""What must hold in every PointCloud."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from pcdata.contracts.tensors import check_ptr_values, check_tensors
from pcdata.errors import DeviceError, DTypeError, ShapeError
from pcdata.geometry.rigid import check_affine
from pcdata.structures.cloud_batch import CloudBatch, check_names
from pcdata.structures.kinds import FIELDS, KINDS, Kind
from pcdata.structures.signals import check_signals

_SPECS = {
    **{name: field.spec for name, field in FIELDS.items()},
    "viewpoint": "B 3",
    "source_from_cloud": "B 4 4 : float64",
}

_FIELD_SPECS = {**{name: field.spec for name, field in FIELDS.items()}, "ptr": "ptr N B"}


def check_cloud(
    cloud: CloudBatch, fields: Mapping[str, Tensor | None], extra: Mapping[str, Tensor], ptr: Tensor
) -> None:
    """Raise unless shapes, dtypes, devices, names and units of a cloud and its per-point fields fit together."""
    poses = {f"frames[{name!r}]": matrix for name, matrix in cloud.frames.items()}
    others = {"viewpoint": cloud.viewpoint, "source_from_cloud": cloud.source_from_cloud, **poses, "ptr": ptr}
    specs = {**_SPECS, **dict.fromkeys(poses, "B 4 4 : float64"), "ptr": "ptr N B"}
    # Shapes only: values are read where data enters (readers, ops), so that a step on a GPU does not wait here.
    sizes = check_tensors("PointCloud", {**fields, **others}, specs, check_values=False)
    if ptr.device.type == "cpu":
        check_ptr_values("PointCloud", "ptr", ptr, sizes["N"])
    _check_extra(extra, cloud.kinds, sizes["N"], ptr)
    for name in ("meta", "history"):
        if (entries := len(vars(cloud)[name])) != sizes["B"]:
            raise ShapeError(f"PointCloud: {name} needs an entry per cloud, {sizes['B']}, got {entries}")
    check_names("PointCloud", cloud.frame_id, cloud.unit)
    if cloud.recorded_signals:
        check_signals(cloud)


def check_fields(fields: Mapping[str, Tensor | None], ptr: Tensor) -> None:
    """Raise unless shapes, dtypes and devices of fields that every cloud may have fit together."""
    check_tensors("PointCloud", {**fields, "ptr": ptr}, _FIELD_SPECS, check_values=False)


def check_motions(where: str, motions: Mapping[str, Tensor]) -> None:
    """Raise unless the motions between frames that clouds are given can be undone."""
    for name, matrix in motions.items():
        check_affine(f"{where}: {name if name == 'source_from_cloud' else f'frames[{name!r}]'}", matrix)


def _check_extra(extra: Mapping[str, Tensor], kinds: Mapping[str, Kind], num_points: int, ptr: Tensor) -> None:
    if set(extra) != set(kinds):
        raise DTypeError(
            f"PointCloud: every extra field needs a kind and only those: fields {sorted(extra)}, kinds {sorted(kinds)}"
        )
    for name, value in extra.items():
        kind = kinds[name]
        if name in FIELDS or not name.isidentifier():
            raise DTypeError(f"PointCloud: {name!r} cannot name an extra field")
        if not isinstance(value, Tensor):
            raise DTypeError(f"PointCloud: extra[{name!r}] must be a torch.Tensor, not {type(value).__name__}")
        if value.device != ptr.device:
            raise DeviceError(
                f"PointCloud: extra[{name!r}] is on {value.device} but points is on {ptr.device}; move one with .to()"
            )
        if name == "viewpoint" and kind is not Kind.POSITION:
            raise DTypeError(f"PointCloud: extra['viewpoint'] is a position, not {kind.value}")
        if value.shape[:1] != (num_points,):
            raise ShapeError(f"PointCloud: extra[{name!r}] has {tuple(value.shape)[:1]} rows, not {num_points}")
        row = KINDS[kind]
        if not row.fits(value.dtype) or row.row not in (None, tuple(value.shape[1:])):
            raise (ShapeError if row.fits(value.dtype) else DTypeError)(
                f"PointCloud: extra[{name!r}] is a {kind.value}: it must be {row.holds}, got {value.dtype} "
                f"{tuple(value.shape)}"
            )
