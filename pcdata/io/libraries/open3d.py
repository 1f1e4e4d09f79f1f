"""The two doors to Open3D."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pcdata.errors import DTypeError
from pcdata.io.libraries.open3d_cameras import (
    camera_of_open3d,
    frame_to_open3d,
    intrinsics_to_open3d,
    posed_of_open3d,
)
from pcdata.io.libraries.open3d_clouds import (
    cloud_to_open3d,
    mesh_of_open3d,
    mesh_to_open3d,
    open3d,
    tensors_of_cloud,
)
from pcdata.io.libraries.rows import cloud_of_tensors, vertices_of
from pcdata.structures import Camera, DepthFrame, Kind, PointCloud, SurfaceMesh


def to_open3d(
    what: PointCloud | SurfaceMesh | Camera | DepthFrame | Sequence[Any],
    *,
    legacy: bool = False,
    fields: Sequence[str] | None = None,
    copy: bool = False,
) -> Any:
    """Return a cloud, a mesh, a camera or a capture as Open3D has it.

    A cloud becomes ``t.geometry.PointCloud`` with every field as an attribute (``point.labels``, ``point.confidence``,
    one value a point as a column), a mesh ``t.geometry.TriangleMesh``, a camera ``camera.PinholeCameraIntrinsic``, a
    capture one :class:`Open3DView` for each view. Several clouds or cameras become a list, and a list becomes a list.

    Tensors share their memory: what Open3D changes in place (``transform``, ``translate``, ``scale``, ``rotate``,
    assigning to elements) changes the cloud too, unless ``copy=True``; what returns a new geometry does not. The older
    classes hold float64, so ``legacy=True`` always copies; float32 becomes float64 without a change.

    Frame, unit, ``meta`` and the way back to the source have no place in Open3D: ``from_open3d(like=cloud)`` gives them
    back.

    Args:
        what: one or several, or a list of them. A normalized cloud is handed over as it is.
        legacy: the older classes, which hold points, colors and normals alone; ``source_index`` is left behind.
        fields: what is handed over besides points or depth, by name; None = all that is there.
        copy: of tensors, do not share memory.

    Raises:
        MissingExtraError: Open3D is not installed, or cannot be loaded.
        DTypeError: a field that the classes have no place for, or nothing that Open3D has.
        DeviceError: memory of a device that this Open3D cannot use.
        IntrinsicsError: a camera with a lens or skewed axes.
    """
    where = "to_open3d"
    open3d()
    if isinstance(what, PointCloud):
        made = [cloud_to_open3d(where, cloud, legacy, fields, copy) for cloud in what]
        return made[0] if len(made) == 1 else made
    if isinstance(what, SurfaceMesh):
        return mesh_to_open3d(where, what, legacy, fields, copy)
    if isinstance(what, Camera):
        cameras = intrinsics_to_open3d(where, what)
        return cameras[0] if len(cameras) == 1 else cameras
    if isinstance(what, DepthFrame):
        return frame_to_open3d(where, what, legacy, fields, copy)
    given: Any = what
    if isinstance(given, (list, tuple)):
        return [to_open3d(one, legacy=legacy, fields=fields, copy=copy) for one in given]
    raise DTypeError(
        f"{where}: takes a PointCloud, SurfaceMesh, Camera, DepthFrame or a list of them, got {type(given).__name__}"
    )


def from_open3d(
    what: Any,
    *,
    frame_id: str | None = None,
    metres_per_unit: float | None = None,
    unit: str | None = None,
    kinds: Mapping[str, Kind | str] | None = None,
    labels_from: str | None = None,
    like: PointCloud | SurfaceMesh | None = None,
    copy: bool = False,
) -> Any:
    """Return what Open3D holds as a :class:`PointCloud`, :class:`SurfaceMesh`, :class:`Camera` or :class:`PosedCamera`.

    Both classes of point clouds and of triangle meshes; a list of point clouds becomes one batch.
    ``camera.PinholeCameraIntrinsic``, or a list, becomes cameras; ``PinholeCameraParameters``, a list of them or a
    ``PinholeCameraTrajectory`` becomes cameras and ``world_from_camera``, the inverse of their extrinsics. Of an image
    ``DepthFrame.from_numpy(np.asarray(image), ...)`` makes a capture.

    Attributes become fields of their names. float32 that needs no change shares its memory; float64 becomes float32,
    colors of bytes 0..1, normals unit length. Normals of triangles are left behind: they follow from the corners.

    Args:
        what: one or a list.
        frame_id: the frame that the coordinates are in, which Open3D does not know; None = that of ``like``.
        metres_per_unit: of the coordinates; None = metres, refused where they do not look like it.
        unit: "normalized" for coordinates that are no lengths; None = that of ``like``, else metres.
        kinds: of fields that are not a cloud's own; others are invariant.
        labels_from: the attribute that holds the labels; "" = none, None = ``labels`` or ``label``.
        like: the cloud, batch or mesh that was handed over, if rows were picked, averaged or given fields since, and
            none was moved: frame, unit, kinds, the way back to the source, signals, meta and history are its own.
        copy: of tensors, do not share memory.

    Raises:
        MissingExtraError: Open3D is not installed, or cannot be loaded.
        FrameError, UnitError: nobody states the frame or the unit, or two state another.
        NonFiniteError: points that are NaN or infinite (``remove_non_finite_points()``).
        CaptureError: textures, covariances, or colors or labels that cannot be meant.
        ShapeError, DTypeError, PoseError, IntrinsicsError: the values cannot be those of what is made.
    """
    where = "from_open3d"
    library = open3d()
    facts: dict[str, Any] = {
        "frame_id": frame_id,
        "metres_per_unit": metres_per_unit,
        "unit": unit,
        "kinds": kinds,
        "labels_from": labels_from,
    }
    several = list(what) if isinstance(what, (list, tuple)) else [what]
    clouds = (library.geometry.PointCloud, library.t.geometry.PointCloud)
    meshes = (library.geometry.TriangleMesh, library.t.geometry.TriangleMesh)
    if several and all(isinstance(one, clouds) for one in several):
        known = vertices_of(where, like)
        if known is not None and known.num_clouds != len(several):
            raise DTypeError(f"{where}: like= has {known.num_clouds} clouds, but {len(several)} are given")
        origins = [None] * len(several) if known is None else known.unbatch()
        made = [
            cloud_of_tensors(where, tensors_of_cloud(where, one, copy), **facts, like=origin)
            for one, origin in zip(several, origins, strict=True)
        ]
        return made[0] if len(made) == 1 else PointCloud.cat(made)
    if isinstance(what, meshes):
        rows, triangles = mesh_of_open3d(where, what, copy)
        known = vertices_of(where, like)
        return SurfaceMesh(vertices=cloud_of_tensors(where, rows, **facts, like=known), triangles=triangles)
    cameras = library.camera
    kinds_of_cameras = (
        cameras.PinholeCameraIntrinsic,
        cameras.PinholeCameraParameters,
        cameras.PinholeCameraTrajectory,
    )
    stated = [name for name, value in {**facts, "like": like}.items() if value is not None]
    if stated and several and all(isinstance(one, kinds_of_cameras) for one in several):
        raise DTypeError(
            f"{where}: a camera has no {stated[0]}, which is said of clouds and meshes alone; leave it out"
        )
    if several and all(isinstance(one, cameras.PinholeCameraIntrinsic) for one in several):
        return camera_of_open3d(several)
    if isinstance(what, cameras.PinholeCameraTrajectory):
        return posed_of_open3d(what.parameters)
    if several and all(isinstance(one, cameras.PinholeCameraParameters) for one in several):
        return posed_of_open3d(several)
    found = type(what).__name__ if several else f"{type(what).__name__} without items"
    raise DTypeError(
        f"{where}: takes a PointCloud or TriangleMesh of open3d.geometry or open3d.t.geometry, a list of point clouds, "
        f"or cameras of open3d.camera, got {found}; of images see pcdata.DepthFrame.from_numpy"
    )
