"""The tabletop world: one call gives a capture together with everything that is true about it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor

from pcdata.errors import ConfigError, ShapeError
from pcdata.rng import generator_for
from pcdata.structures import Camera, DepthFrame
from pcdata.synthetic.heap import heap_objects
from pcdata.synthetic.raycast import Hits, cast, ray_directions
from pcdata.synthetic.scene import make_floor, make_table, place_objects
from pcdata.synthetic.shading import own_colors, shade
from pcdata.synthetic.shapes import Box, Shape
from pcdata.synthetic.stereo_camera import SensorNoise, noise_named
from pcdata.synthetic.viewpoints import Miscalibration, place_cameras
from pcdata.threads import torch_on_one_thread

BASE_FRAME = "base"


@dataclass(frozen=True, eq=False, kw_only=True)
class _TabletopTruth:
    """What is true about a scene, in the base frame (z up, table top at z = 0), whatever the sensor reported."""

    depth: Tensor  # (V, H, W) float64 metres, exact z-depth, 0 = nothing there
    normals: Tensor  # (V, H, W, 3) float64 unit, base frame, toward the camera; zero where nothing is
    labels: Tensor  # (V, H, W) int64: 0 table, 1..K objects, -1 floor or nothing
    world_from_camera: Tensor  # (V, 4, 4) float64, the poses the images were rendered from
    camera: Camera
    table: Box
    floor: Box | None
    objects: tuple[Shape, ...]  # objects[k] has label k + 1

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """Every solid of the scene."""
        return (self.table, *self.objects, *([] if self.floor is None else [self.floor]))

    @property
    def table_plane(self) -> Tensor:
        """(4,) float64 plane a x + b y + c z + d = 0 of the table top in the base frame, normal up."""
        return torch.tensor([0.0, 0.0, 1.0, 0.0], dtype=torch.float64, device=self.depth.device)


@dataclass(frozen=True, eq=False, kw_only=True)
class Tabletop:
    """A scene as a sensor reported it (``frame``) and as it is (``truth``)."""

    frame: DepthFrame
    truth: _TabletopTruth
    seed: int
    noise: SensorNoise | None

    @torch_on_one_thread()
    def render(self, seed_noise: int = 0) -> DepthFrame:
        """Return the same scene from the same cameras under another draw of the sensor's noise.

        ``seed_noise`` is also the capture index; 0 gives ``frame``. Without noise all renders have equal depth.
        """
        depth = _sensed(self.truth, self.noise, self.seed, seed_noise)
        provenance = {**self.frame.provenance, "seed_noise": seed_noise}
        return replace(self.frame, depth=depth, capture_index=seed_noise, provenance=provenance)

    def noisy_frames(self, count: int) -> Iterator[DepthFrame]:
        """Yield ``count`` captures of the still scene by still cameras, capture index 0, 1, ..."""
        return (self.render(seed_noise=index) for index in range(count))

    def surface_distance(self, points: Tensor) -> Tensor:
        """Return the (N,) distance in metres from (N, 3) points in the base frame to the nearest true surface.

        Exact for points in free space; a face that rests on another counts as surface too.
        """
        if points.ndim != 2 or points.shape[1] != 3:
            raise ShapeError(f"Tabletop.surface_distance: points must be (N, 3), got {tuple(points.shape)}")
        return torch.stack([shape.signed_distance(points.double()).abs() for shape in self.truth.shapes]).amin(0)


@torch_on_one_thread()
def tabletop(
    seed: int = 0,
    num_objects: int = 5,
    num_views: int = 1,
    *,
    noise: SensorNoise | str | None = None,
    size: tuple[int, int] = (480, 640),
    miscalibration: Miscalibration | None = None,
    floor: bool = True,
    touching: bool = False,
    camera: Camera | None = None,
    world_from_camera: Tensor | None = None,
    sample_id: str | None = None,
    device: torch.device | str = "cpu",
) -> Tabletop:
    """Render boxes, cylinders and balls that rest on a table, seen by cameras around and above it.

    The objects depend on ``seed`` alone (more objects leave the first ones in place), view v on (seed, v), the noise on
    (seed, v) too; all are drawn on the CPU, so every device sees one scene.

    Args:
        seed: names the scene.
        num_objects: boxes, cylinders and spheres mixed; 30 fit.
        num_views: how many cameras; ignored where ``world_from_camera`` is given.
        noise: a sensor model, "stereo" for its defaults, "none" or None for exact depth.
        size: (height, width) in pixels; ignored where ``camera`` is given.
        miscalibration: a known error of the reported poses; the images stay as they are.
        touching: boxes, cans, balls, bowls and mugs that are pushed together until they touch, every sixth on top of
            another, instead of objects that stand apart.
        floor: False leaves the space around the table empty (depth 0).
        camera: one camera for every view, or V cameras; None = a typical depth camera.
        world_from_camera: (V, 4, 4) float64 true poses, for example from :func:`look_at`; None = around the table.
        sample_id: None = ``tabletop-<seed>``.
        device: where to render and keep the result.

    Raises:
        ConfigError: a count out of range, objects that do not fit, an unknown noise, amounts that match no view.
    """
    sensor = noise_named(noise)
    num_views = num_views if world_from_camera is None else len(world_from_camera)
    if num_objects < 0 or num_views < 1:
        raise ConfigError(f"tabletop: needs num_objects >= 0 and num_views >= 1, got {num_objects} and {num_views}")
    usual_camera, usual_poses = place_cameras(seed, num_views, size if camera is None else camera.size)
    camera = usual_camera if camera is None else _one_per_view(camera, num_views)
    poses = (usual_poses if world_from_camera is None else world_from_camera).double().to(device)

    objects = heap_objects(seed, num_objects) if touching else place_objects(seed, num_objects)
    truth, colors = rendered(camera.to(device), poses, make_table(), make_floor() if floor else None, objects)
    provenance: dict[str, Any] = {
        "source": "pcdata.synthetic.tabletop",
        "seed": seed,
        "num_objects": num_objects,
        "floor": floor,
        **({"touching": True} if touching else {}),
        "noise": None if sensor is None else asdict(sensor),
        "seed_noise": 0,
        "miscalibration": None if miscalibration is None else asdict(miscalibration),
    }
    frame = DepthFrame(
        depth=_sensed(truth, sensor, seed, 0),
        camera=truth.camera,
        colors=colors,
        labels=truth.labels,
        world_from_camera=poses if miscalibration is None else miscalibration.apply(poses, seed),
        frame_id=BASE_FRAME,
        sample_id=f"tabletop-{seed:04d}" if sample_id is None else sample_id,
        provenance=provenance,
    )
    return Tabletop(frame=frame, truth=truth, seed=seed, noise=sensor)


def rendered(
    camera: Camera, poses: Tensor, table: Box, floor: Box | None, objects: tuple[Shape, ...], *, lit: bool = True
) -> tuple[_TabletopTruth, Tensor]:
    """Return what is true about a scene as V cameras see it, and (V, H, W, 3) uint8 colors, with light or without."""
    shapes = [*objects, table, *([] if floor is None else [floor])]  # objects first: they win where they touch
    names = [*(shape.label for shape in shapes), -1]  # index -1: nothing
    labels_of = torch.tensor(names, dtype=torch.int64, device=poses.device)
    views: list[Hits] = []
    colors: list[Tensor] = []
    focals = camera.intrinsics[:, 0, 0].tolist()
    for rays, pose, focal in zip(ray_directions(camera), poses, focals):
        directions, eye = rays.reshape(-1, 3) @ pose[:3, :3].T, pose[None, :3, 3]
        hits = cast(shapes, eye, directions)
        views.append(hits)
        colors.append(shade(shapes, hits, eye, directions, focal) if lit else own_colors(shapes, hits))
    images = (len(poses), *camera.size)
    depth, normals, shape_index = (torch.stack(parts) for parts in zip(*views))
    truth = _TabletopTruth(
        depth=torch.where(torch.isfinite(depth), depth, 0.0).reshape(images),
        normals=normals.reshape(*images, 3),
        labels=labels_of[shape_index].reshape(images),
        world_from_camera=poses,
        camera=camera,
        table=table,
        floor=floor,
        objects=objects,
    )
    return truth, torch.stack(colors).reshape(*images, 3)


def _sensed(truth: _TabletopTruth, noise: SensorNoise | None, seed: int, seed_noise: int) -> Tensor:
    if noise is None:
        return truth.depth.float()
    streams = [generator_for(seed, seed_noise, f"synthetic/noise/{view}") for view in range(len(truth.depth))]
    return noise.apply(truth.depth, truth.camera.intrinsics[:, 0, 0], streams)


def _one_per_view(camera: Camera, num_views: int) -> Camera:
    if camera.num_views == num_views:
        return camera
    if camera.num_views != 1:
        raise ConfigError(
            f"tabletop: camera describes {camera.num_views} views but there are {num_views}; give 1 or all"
        )
    distortion = None if camera.distortion is None else camera.distortion.repeat(num_views, 1)
    return replace(camera, intrinsics=camera.intrinsics.repeat(num_views, 1, 1), distortion=distortion)
