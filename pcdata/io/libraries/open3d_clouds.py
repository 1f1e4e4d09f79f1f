"""Clouds and meshes <-> Open3D's geometries: the tensor classes (``open3d.t``), and the older ones (legacy)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils import dlpack

from pcdata import extras
from pcdata.errors import CaptureError, DeviceError, DTypeError, ShapeError
from pcdata.io.libraries.rows import chosen_fields
from pcdata.structures import PointCloud, SurfaceMesh

_LEGACY = ("points", "colors", "normals")
_FOLLOWS = ("normals",)  # of a triangle, from its corners


def open3d() -> Any:
    """Return the library; a missing one is told with what installs it."""
    return extras.require("open3d")


# -- out ---------------------------------------------------------------------------------------------------------------


def cloud_to_open3d(where: str, cloud: PointCloud, legacy: bool, fields: Sequence[str] | None, copy: bool) -> Any:
    """Return one cloud as ``t.geometry.PointCloud``, or ``geometry.PointCloud``."""
    library = open3d()
    kept = chosen_fields(where, cloud, fields)
    if legacy:
        geometry = library.geometry.PointCloud()
        geometry.points = _vectors(library, kept["points"])
        return _with_legacy(where, library, geometry, kept, fields, "colors", "normals")
    geometry = library.t.geometry.PointCloud(device_of(where, cloud.device))
    _attach(where, geometry.point, kept, copy)
    return geometry


def mesh_to_open3d(where: str, mesh: SurfaceMesh, legacy: bool, fields: Sequence[str] | None, copy: bool) -> Any:
    """Return a mesh as ``t.geometry.TriangleMesh``, or ``geometry.TriangleMesh``."""
    library = open3d()
    kept = chosen_fields(where, mesh.vertices, fields)
    if legacy:
        geometry = library.geometry.TriangleMesh()
        geometry.vertices = _vectors(library, kept["points"])
        geometry.triangles = library.utility.Vector3iVector(mesh.triangles.cpu().numpy().astype(np.int32))
        return _with_legacy(where, library, geometry, kept, fields, "vertex_colors", "vertex_normals")
    geometry = library.t.geometry.TriangleMesh(device_of(where, mesh.vertices.device))
    _attach(where, geometry.vertex, kept, copy)
    geometry.triangle["indices"] = to_library(where, mesh.triangles, copy)
    return geometry


def _with_legacy(
    where: str,
    library: Any,
    geometry: Any,
    kept: dict[str, Tensor],
    fields: Sequence[str] | None,
    colors: str,
    normals: str,
) -> Any:
    strange = [name for name in kept if name not in _LEGACY and not (name == "source_index" and fields is None)]
    if strange:
        raise DTypeError(
            f"{where}: the older classes of Open3D have no place for {', '.join(strange)}; leave legacy=True out, or "
            f"say what is handed over: fields={tuple(name for name in kept if name in _LEGACY[1:])}"
        )
    if "colors" in kept:
        setattr(geometry, colors, _vectors(library, kept["colors"]))
    if "normals" in kept:
        setattr(geometry, normals, _vectors(library, kept["normals"]))
    return geometry


def _vectors(library: Any, rows: Tensor) -> Any:
    return library.utility.Vector3dVector(rows.cpu().numpy().astype(np.float64))


def _attach(where: str, attributes: Any, fields: dict[str, Tensor], copy: bool) -> None:
    """Hand over every field; of one value a point as a column, as Open3D's own readers and writers have it."""
    for name, value in fields.items():
        column = value[:, None] if value.ndim == 1 else value
        attributes["positions" if name == "points" else name] = to_library(f"{where}: {name}", column, copy)


def to_library(where: str, value: Tensor, copy: bool) -> Any:
    """Return the same memory, or a copy, as ``open3d.core.Tensor``: by NumPy in host memory, by DLPack elsewhere."""
    value = value.detach()
    value = value.clone(memory_format=torch.contiguous_format) if copy else value
    tensors = open3d().core.Tensor
    if value.device.type == "cpu":
        return tensors.from_numpy(value.numpy())
    device_of(where, value.device)
    return tensors.from_dlpack(dlpack.to_dlpack(value))  # type: ignore[attr-defined]


def device_of(where: str, device: torch.device) -> Any:
    """Return the device by Open3D's name.

    Raises:
        DeviceError: it has no such device.
    """
    library = open3d()
    if device.type == "cpu":
        return library.core.Device("CPU:0")
    if device.type != "cuda" or not library.core.cuda.is_available():
        raise DeviceError(f"{where}: is on {device}, which this Open3D cannot use; give it .cpu()")
    return library.core.Device(f"CUDA:{device.index or 0}")


# -- in ----------------------------------------------------------------------------------------------------------------


def tensors_of_cloud(where: str, geometry: Any, copy: bool) -> dict[str, Tensor]:
    """Return the rows of either class of cloud, by name."""
    if is_legacy(geometry):
        if geometry.has_covariances():
            raise CaptureError(
                f"{where}: has covariances, which would not move with the cloud; take them off first: "
                "geometry.covariances = open3d.utility.Matrix3dVector()"
            )
        return _legacy_rows(geometry.points, geometry.colors, geometry.normals)
    return _rows(where, geometry.point, copy)


def mesh_of_open3d(where: str, geometry: Any, copy: bool) -> tuple[dict[str, Tensor], Tensor]:
    """Return the rows of the vertices of either class of mesh, and its (T, 3) int64 triangles."""
    if is_legacy(geometry):
        if geometry.has_triangle_uvs() or geometry.has_textures():
            raise CaptureError(
                f"{where}: has textures, for which a SurfaceMesh has no place; color the vertices, and take the "
                "textures off: mesh.triangle_uvs = open3d.utility.Vector2dVector(); mesh.textures = []"
            )
        rows = _legacy_rows(geometry.vertices, geometry.vertex_colors, geometry.vertex_normals)
        return rows, torch.from_numpy(np.asarray(geometry.triangles).astype(np.int64))
    strange = [name for name in geometry.triangle if name not in ("indices", *_FOLLOWS)]
    if strange:
        raise CaptureError(
            f"{where}: its triangles have {', '.join(strange)}, for which a SurfaceMesh has no place; take them off: "
            f"del mesh.triangle[{strange[0]!r}]"
        )
    rows = _rows(where, geometry.vertex, copy)
    if "indices" not in geometry.triangle:
        return rows, torch.zeros((0, 3), dtype=torch.int64, device=rows["points"].device)
    return rows, to_torch(geometry.triangle["indices"], copy).to(torch.int64)


def is_legacy(geometry: Any) -> bool:
    """Whether an object of Open3D is of its older classes."""
    return ".t." not in type(geometry).__module__ + "."


def _legacy_rows(points: Any, colors: Any, normals: Any) -> dict[str, Tensor]:
    rows = {"points": _array(points)}
    rows |= {name: _array(value) for name, value in (("colors", colors), ("normals", normals)) if len(value)}
    return {name: torch.from_numpy(value) for name, value in rows.items()}


def _array(vectors: Any) -> NDArray[np.float64]:
    return np.array(vectors, dtype=np.float64).reshape(-1, 3)


def _rows(where: str, attributes: Any, copy: bool) -> dict[str, Tensor]:
    if "positions" not in attributes:
        raise ShapeError(f"{where}: the geometry has no positions; of no points set positions of shape (0, 3)")
    rows = {"points": to_torch(attributes["positions"], copy)}
    return rows | {name: to_torch(attributes[name], copy) for name in attributes if name != "positions"}


def to_torch(value: Any, copy: bool) -> Tensor:
    """Return the same memory, or a copy, as a torch tensor; unsigned integers of 16 to 64 bits as wider ones."""
    if value.device.get_type() != open3d().core.Device.DeviceType.CPU:
        made = dlpack.from_dlpack(value.to_dlpack())
        return made.clone() if copy else made
    array = value.numpy()
    if array.dtype in (np.uint16, np.uint32, np.uint64):
        return torch.from_numpy(array.astype(np.int32 if array.dtype == np.uint16 else np.int64))
    return torch.from_numpy(array.copy() if copy else array)
