"""What must hold in every PointCloud."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from pcdata.contracts.tensors import check_ptr_values, check_tensors
from pcdata.errors import DeviceError, DTypeError, FrameError, ShapeError, UnitError
from pcdata.structures.kinds import CORE_KINDS, METRE, NORMALIZED, Kind

if TYPE_CHECKING:
    from pcdata.structures.point_cloud import PointCloud


def check_cloud(cloud: PointCloud) -> None:
    """Raise unless shapes, dtypes, devices, names and units of a cloud fit together."""
    values = {
        "points": cloud.points,
        "ptr": cloud.ptr,
        "colors": cloud.colors,
        "normals": cloud.normals,
        "labels": cloud.labels,
        "source_index": cloud.source_index,
        "viewpoint": cloud.viewpoint,
        "source_from_cloud": cloud.source_from_cloud,
    }
    specs = {
        "points": "N 3",
        "colors": "N 3",
        "normals": "N 3",
        "labels": "N : int64",
        "source_index": "N : int64",
        "viewpoint": "B 3",
        "source_from_cloud": "B 4 4 : float64",
        "ptr": "ptr N B",
    }
    # Shapes only: values are read where data enters (readers, ops), so that a step on a GPU does not wait here.
    sizes = check_tensors("PointCloud", values, specs, check_values=False)
    if cloud.ptr.device.type == "cpu":
        check_ptr_values("PointCloud", "ptr", cloud.ptr, sizes["N"])
    _check_extra(cloud, sizes["N"])
    poses = {f"frames[{name!r}]": matrix for name, matrix in cloud.frames.items()}
    check_tensors(
        "PointCloud",
        {"source_from_cloud": cloud.source_from_cloud, **poses},
        dict.fromkeys(["source_from_cloud", *poses], "B 4 4 : float64"),
        check_values=False,
    )
    for name in ("meta", "history"):
        if len(getattr(cloud, name)) != cloud.num_clouds:
            raise ShapeError(
                f"PointCloud: {name} needs an entry per cloud, {cloud.num_clouds}, got {len(getattr(cloud, name))}"
            )
    check_names(cloud)


def check_names(cloud: PointCloud) -> None:
    """Raise unless the frame has a name and the unit is a known one."""
    if not cloud.frame_id:
        raise FrameError("PointCloud: frame_id must name the coordinate frame, it is empty")
    if cloud.unit not in (METRE, NORMALIZED):
        raise UnitError(f"PointCloud: unit must be {METRE!r} or {NORMALIZED!r}, got {cloud.unit!r}")


def _check_extra(cloud: PointCloud, num_points: int) -> None:
    if set(cloud.extra) != set(cloud.kinds):
        raise DTypeError(
            f"PointCloud: every extra field needs a kind and only those: fields {sorted(cloud.extra)}, "
            f"kinds {sorted(cloud.kinds)}"
        )
    for name, value in cloud.extra.items():
        if name in CORE_KINDS or not name.isidentifier():
            raise DTypeError(f"PointCloud: {name!r} cannot name an extra field")
        if not isinstance(value, Tensor):
            raise DTypeError(f"PointCloud: extra[{name!r}] must be a torch.Tensor, not {type(value).__name__}")
        if value.device != cloud.points.device:
            raise DeviceError(
                f"PointCloud: extra[{name!r}] is on {value.device} but points is on {cloud.points.device}; "
                "move one with .to()"
            )
        if name == "viewpoint" and cloud.kinds[name] is not Kind.POSITION:
            raise DTypeError(f"PointCloud: extra['viewpoint'] is a position, not {cloud.kinds[name].value}")
        if value.shape[:1] != (num_points,):
            raise ShapeError(f"PointCloud: extra[{name!r}] has {tuple(value.shape)[:1]} rows, not {num_points}")
        if cloud.kinds[name] is Kind.MINIMUM and (value.is_floating_point() or value.is_complex()):
            raise DTypeError(f"PointCloud: extra[{name!r}] is a minimum: it must hold integers, not {value.dtype}")
        if cloud.kinds[name] in (Kind.POSITION, Kind.DIRECTION) and (
            value.shape != (num_points, 3) or not value.is_floating_point()
        ):
            raise ShapeError(f"PointCloud: extra[{name!r}] is a {cloud.kinds[name].value}: it must be float (N, 3)")
