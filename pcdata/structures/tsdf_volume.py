"""TSDFVolume: views go in one after another, one surface comes out."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from pcdata.contracts.on_host import on_host
from pcdata.errors import CaptureError, ConfigError, DeviceError, DTypeError, FrameError, VolumeTooLargeError
from pcdata.functional import tsdf
from pcdata.functional.depth.confidence import Confidence
from pcdata.functional.depth.deproject import check_rays, pixel_rays
from pcdata.functional.tsdf.views import UNIT_WEIGHT
from pcdata.geometry.lens_models import WIDEST_PLAIN
from pcdata.structures.depth_frame import DepthFrame
from pcdata.structures.kinds import Kind
from pcdata.structures.point_cloud import PointCloud
from pcdata.structures.surface_mesh import SurfaceMesh

_CAMERAS_KEPT = 8  # 7 MB each at 640x480


@dataclass(eq=False, kw_only=True)
class TSDFVolume:
    """A sparse truncated signed distance field that averages depth images into one surface.

    The result depends on the frames and their order alone, not on threads; with ``carve="never"`` not on the order
    either, up to rounding.

    ``carve`` says what a view does that sees past a voxel by more than the truncation: a full truncation joins the
    voxel's average, so that a surface which others see through is worn away. ``"near"`` the surface it sees, in the
    blocks the view opens, is how fields are averaged since Curless & Levoy, and merges the sheets that noise and drift
    leave; ``"everywhere"`` also removes what has moved away, by a pass over all blocks per view; ``"never"`` keeps
    every surface that any view saw. Voxels that no view saw near a surface stay unseen.

    Args:
        voxel_size: metres.
        truncation: metres on either side of a surface; None = 5 voxels.
        weighting: how much a reading counts; see functional.tsdf.weight_image.
        min_confidence: readings that are less to be trusted do not count.
        max_bytes: refuse to grow beyond.
        device: where the voxels are stored and fusion runs.
        backend: see pcdata.contracts.dispatch.
        frame_id: the frame of the surface; None = that of the first frame.
        num_views: how many views have gone in.
    """

    voxel_size: float = 0.002
    truncation: float | None = None
    weighting: tsdf.Weighting = "constant"
    carve: tsdf.Carving = "near"
    min_confidence: Confidence | None = None
    max_bytes: int = 4 << 30
    device: torch.device | str = "cpu"
    backend: str = "auto"
    frame_id: str | None = None
    num_views: int = field(default=0, init=False)
    blocks: tsdf.VoxelBlocks | None = field(default=None, init=False, repr=False)
    room: tsdf.VoxelRoom = field(init=False, repr=False)  # that the blocks lie in
    _kept_rays: dict[tuple[float, ...], tuple[Tensor, Tensor]] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        for name, known in (("weighting", get_args(tsdf.Weighting)), ("carve", get_args(tsdf.Carving))):
            if getattr(self, name) not in known:
                raise ConfigError(f"TSDFVolume: {name} must be one of {known}, got {getattr(self, name)!r}")
        if self.max_bytes < 1:
            raise ConfigError(f"TSDFVolume: max_bytes must be at least 1, got {self.max_bytes}")
        self.device = torch.device(self.device)
        self.truncation = self.grid.truncation
        self.room = tsdf.VoxelRoom(self.device)

    @property
    def grid(self) -> tsdf.VoxelGrid:
        """The lengths, checked."""
        return tsdf.VoxelGrid(self.voxel_size, 5 * self.voxel_size if self.truncation is None else self.truncation)

    @property
    def num_blocks(self) -> int:
        """How many blocks of 8 x 8 x 8 voxels there are."""
        return 0 if self.blocks is None else len(self.blocks)

    @property
    def num_bytes(self) -> int:
        """The memory that the blocks take."""
        return 0 if self.blocks is None else len(self.blocks) * tsdf.bytes_per_block(self.blocks.planes)

    @property
    def reserved_bytes(self) -> int:
        """The memory that blocks can take before the volume asks the system for more."""
        return self.room.num_bytes

    # -- in --------------------------------------------------------------------------------------------------------

    def integrate(self, frame: DepthFrame) -> None:
        """Average every view of a capture into the field.

        The first frame decides whether the volume holds colors and labels, and the coordinate frame; those that follow
        must agree. A frame that is refused leaves the volume as it was.

        Raises:
            FrameError: the frame has no poses, or they lead to another frame.
            CaptureError: it has other images than the first one.
            VolumeTooLargeError: the blocks it needs would exceed ``max_bytes``, and nothing was allocated; or the
                system has no memory for them.
            DeviceError: it is on another device.
            UnitError: a reading lies 2^20 blocks or more from the origin.
        """
        blocks, views, found, new = self._located(frame)
        self._check_room(frame, len(new))
        blocks.add(new)
        self.frame_id, self.blocks = frame.frame_id, blocks
        for view, rows in zip(views, found, strict=True):
            if self.carve == "everywhere":
                rows = torch.arange(len(blocks), dtype=torch.int64, device=frame.device)
            tsdf.integrate_view(blocks, rows, view, self.grid, carve=self.carve != "never", backend=self.backend)
        self.num_views += len(views)

    def reserve(self, num_bytes: int | np.integer[Any]) -> None:
        """Take memory for the volume now, so that frames which need no more of it never wait for the system.

        ``num_bytes`` counts all blocks, those that are there too, as :attr:`num_bytes` and :meth:`estimate_bytes` do;
        less than there is changes nothing. The memory is written to once, in pages of 2 MB where the system has
        them, and nothing that is stored is moved, now or later. On a GPU up to 64 MiB more are taken.

        Raises:
            ConfigError: ``num_bytes`` is not a whole number of at least 1.
            VolumeTooLargeError: it is more than ``max_bytes``, or than the device has.
        """
        if isinstance(num_bytes, np.integer):  # such as a sum of NumPy's
            num_bytes = int(num_bytes)
        if type(num_bytes) is not int or num_bytes < 1:
            raise ConfigError(f"TSDFVolume.reserve: num_bytes must be a whole number from 1 on, got {num_bytes!r}")
        if num_bytes > self.max_bytes:
            raise VolumeTooLargeError(
                f"TSDFVolume.reserve: {num_bytes / 2**20:.1f} MiB are more than max_bytes allows, "
                f"{self.max_bytes / 2**20:.1f} MiB; ask for less, or allow more"
            )
        self.room.reserve(num_bytes)

    def clear(self) -> None:
        """Forget all views and keep the memory, so that the next ones find it there.

        What the first frame decided stays: the coordinate frame, and whether there are colors and labels.
        """
        if self.blocks is not None:
            self.blocks.clear()
        self.num_views = 0

    def estimate_bytes(self, frame: DepthFrame) -> int:
        """Return the memory that the blocks would take with this frame, without allocating any; exact.

        Raises:
            FrameError, CaptureError, DeviceError, UnitError: as :meth:`integrate`.
        """
        _, _, _, new = self._located(frame)
        return (self.num_blocks + len(new)) * tsdf.bytes_per_block(self._planes_of(frame))

    def _located(self, frame: DepthFrame) -> tuple[tsdf.VoxelBlocks, list[tsdf.FusionView], list[Tensor], Tensor]:
        """Return the blocks, the views of a frame that fits, the rows of their blocks, and the keys to add first."""
        self._check_frame(frame)
        views = [self._view(frame, index) for index in range(frame.num_views)]
        blocks = self.blocks
        if blocks is None:
            blocks = tsdf.VoxelBlocks(self._planes_of(frame), frame.device, room=self.room)
        return blocks, views, *tsdf.locate_views(blocks, views, self.grid, backend=self.backend)

    def _check_room(self, frame: DepthFrame, new: int) -> None:
        per_block = tsdf.bytes_per_block(self._planes_of(frame))
        needed = (self.num_blocks + new) * per_block
        if needed > self.max_bytes:
            raise VolumeTooLargeError(
                f"TSDFVolume: {frame!r} needs {new} more blocks of {per_block} bytes at voxels of "
                f"{self.voxel_size:g} m, {needed / 2**20:.1f} MiB in all, but max_bytes allows "
                f"{self.max_bytes / 2**20:.1f} MiB; use larger voxels, mask depth outside the workspace (MaskDepth), "
                "or allow more"
            )

    def _planes_of(self, frame: DepthFrame) -> dict[str, torch.dtype]:
        images = {"colors": frame.colors is not None, "labels": frame.labels is not None}
        return tsdf.voxel_planes(**images, views=self.weighting != "constant")

    def _check_frame(self, frame: DepthFrame) -> None:
        if not isinstance(frame, DepthFrame):
            raise DTypeError(
                f"TSDFVolume.integrate takes a DepthFrame, got {type(frame).__name__}; fusing needs depth images and "
                "where each was seen from: give the captures that the clouds are of"
            )
        if frame.world_from_camera is None:
            raise FrameError(
                f"TSDFVolume: {frame!r} has no world_from_camera, so its views cannot be put together; give it poses: "
                "world_from_camera= of arrays, poses/NAME.txt of a plain folder, --calibration FILE --frame NAME, or "
                "--posed FILE"
            )
        if self.frame_id is not None and frame.frame_id != self.frame_id:
            raise FrameError(
                f"TSDFVolume: the surface is in frame {self.frame_id!r} but the poses of {frame!r} lead to "
                f"{frame.frame_id!r}; bring both to one frame"
            )
        if frame.device != self.device:
            raise DeviceError(f"TSDFVolume: {frame!r} is on {frame.device}, the volume on {self.device}; move one")
        if self.blocks is not None and self._planes_of(frame) != self.blocks.planes:
            had, has = self.blocks.planes, self._planes_of(frame)
            raise CaptureError(
                f"TSDFVolume: every frame needs the images of the first, which had colors: {'color' in had}, labels: "
                f"{'label' in had}; {frame!r} has colors: {'color' in has}, labels: {'label' in has}"
            )
        if frame.labels is not None and frame.device.type == "cpu":
            tsdf.check_labels(frame.labels)

    def _view(self, frame: DepthFrame, index: int) -> tsdf.FusionView:
        camera = frame.camera
        k = on_host(camera.intrinsics)[index]
        lens = None if camera.distortion is None else on_host(camera.distortion)[index]
        rays, directions = self._rays(k, lens, frame)
        depth = frame.depth[index]
        if self.min_confidence is not None and frame.confidence is not None:
            depth = torch.where(frame.confidence[index] >= self.min_confidence, depth, 0.0)
        if lens is not None:
            check_rays("TSDFVolume", rays[None], (depth > 0)[None])
        assert frame.world_from_camera is not None
        label = unfit = None
        if frame.labels is not None:
            label = tsdf.pack_labels(frame.labels[index])
            if frame.device.type != "cpu":  # to know now, the host would have to wait
                unfit = (label != frame.labels[index]).any().reshape(1)
        return tsdf.FusionView(
            depth=depth,
            rays=directions,
            pinhole=(float(k[0, 0]), float(k[0, 1]), float(k[0, 2]), float(k[1, 1]), float(k[1, 2])),
            distortion=None if lens is None else pad(lens.double(), (0, max(0, WIDEST_PLAIN - len(lens)))),
            world_from_camera=on_host(frame.world_from_camera)[index],
            weight=tsdf.weight_image(depth, rays, self.weighting),
            color=None if frame.colors is None else tsdf.pack_colors(frame.colors[index], backend=self.backend),
            label=label,
            unfit=unfit,
        )

    def _rays(self, k: Tensor, lens: Tensor | None, frame: DepthFrame) -> tuple[Tensor, Tensor]:
        """Return the rays of a camera, (H, W, 2) float64 and (2, H, W) float32; kept, because frames repeat cameras."""
        coefficients = () if lens is None else tuple(lens.tolist())
        known = (*k.flatten().tolist(), *coefficients, *frame.size)
        if known not in self._kept_rays:
            if len(self._kept_rays) >= _CAMERAS_KEPT:
                self._kept_rays.pop(next(iter(self._kept_rays)))
            rays = pixel_rays(k[None], frame.size, None if lens is None else lens[None])[0].to(frame.device)
            self._kept_rays[known] = rays, rays.permute(2, 0, 1).float().contiguous()
        return self._kept_rays[known]

    # -- out -------------------------------------------------------------------------------------------------------

    def extract_points(self, *, min_weight: float = 0.0) -> PointCloud:
        """Return the points where the field crosses zero along the edges of its grid.

        They carry normals out of the surface, colors and labels where the frames had them, and
        ``extra["num_views"]`` and ``extra["weight"]``, of the edge's end that was seen less; views that wear it away
        count too. The label is the one that most views gave if more than half did. The history says what ``min_weight``
        dropped.

        Args:
            min_weight: the least weight of both ends of an edge. 0 keeps whatever was seen, right for few views; with
                constant weights, n asks for n views.

        Raises:
            ConfigError: nothing was integrated yet.
        """
        return self._cloud(self._surface(min_weight, edges=False), min_weight)

    def extract_mesh(self, *, min_weight: float = 0.0) -> SurfaceMesh:
        """Return the surface as triangles between the points of :meth:`extract_points`.

        Only cubes with eight seen corners hold triangles, so single views give a surface with gaps at its rim.
        Points that are in no triangle are left out.
        """
        found = self._surface(min_weight, edges=True)
        assert self.blocks is not None
        least = self._least_weight(min_weight)
        used, triangles = tsdf.find_triangles(self.blocks, found.edge, min_weight=least, backend=self.backend)
        return SurfaceMesh(vertices=self._cloud(found.select(used), min_weight), triangles=triangles)

    def _least_weight(self, min_weight: float) -> int:
        if not (math.isfinite(min_weight) and min_weight >= 0):
            raise ConfigError(f"TSDFVolume: min_weight must be finite and at least 0, got {min_weight}")
        return max(1, math.ceil(min_weight * self._unit))

    @property
    def _unit(self) -> int:
        return 1 if self.weighting == "constant" else UNIT_WEIGHT

    def _surface(self, min_weight: float, *, edges: bool) -> tsdf.Crossings:
        if self.blocks is None or self.num_views == 0:
            raise ConfigError("TSDFVolume: nothing was integrated yet")
        least = self._least_weight(min_weight)
        return tsdf.find_crossings(self.blocks, self.grid, min_weight=least, edges=edges, backend=self.backend)

    def _cloud(self, found: tsdf.Crossings, min_weight: float) -> PointCloud:
        assert self.frame_id is not None
        step: dict[str, Any] = {
            "step": "TSDFVolume",
            "voxel_size": self.voxel_size,
            "truncation": self.truncation,
            "weighting": self.weighting,
            "carve": self.carve,
            "views": self.num_views,
            "min_weight": min_weight,
            "dropped": found.dropped,
            "points": len(found.points),
        }
        return PointCloud(
            points=found.points,
            frame_id=self.frame_id,
            normals=found.normals,
            colors=found.colors,
            labels=found.labels,
            extra={"num_views": found.views, "weight": found.weight if self._unit == 1 else found.weight / self._unit},
            kinds={"num_views": Kind.INVARIANT, "weight": Kind.INVARIANT},
            frames={self.frame_id: torch.eye(4, dtype=torch.float64, device=found.points.device)[None]},
            history=[[step]],
        )
