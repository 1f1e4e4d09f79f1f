"""Small clouds and captures whose truth is known, and deep comparison of all that they carry."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from pcdata.functional.depth.sensor_noise import facing_depth
from pcdata.functional.rows import ptr_from_counts, transform_points
from pcdata.geometry import rigid
from pcdata.rng import seeded
from pcdata.structures import Camera, DepthFrame, Kind, PointCloud
from pcdata.synthetic import tabletop

# Where the balls of a cloud stand on the table z = 0, in the base frame, and their radius; metres.
BALLS = torch.tensor([[-0.10, 0.0, 0.05], [0.10, 0.05, 0.05]])
BALL_RADIUS = 0.02

Made = TypeVar("Made", bound=Callable[..., Any])


def _made_once(make: Made) -> Made:
    """Make what is asked for once, and give a copy of it each time: a sixth of the time, and tests share nothing."""
    kept = functools.lru_cache(maxsize=64)(make)

    @functools.wraps(make)
    def copied(first: Any = None, **options: Any) -> Any:
        arguments = () if first is None else (tuple(first) if isinstance(first, Sequence) else first,)
        if torch.is_inference_mode_enabled() or torch.get_default_dtype() is not torch.float32:
            return make(*arguments, **options)
        if torch.get_default_device().type != "cpu":
            return make(*arguments, **options)
        return copy.deepcopy(kept(*arguments, **options))

    return copied  # type: ignore[return-value]


def base_from_camera(num_clouds: int = 1, *, seed: int = 0) -> Tensor:
    """(B, 4, 4) poses about 0.8 m above the table, each another one."""
    generator = seeded(seed)
    poses = []
    for _ in range(num_clouds):
        quaternion = torch.randn(4, generator=generator, dtype=torch.float64)
        offset = torch.tensor([0.0, 0.0, 0.8]) + 0.1 * torch.rand(3, generator=generator)
        poses.append(rigid.from_rotation_translation(rigid.rotation_from_quaternion(quaternion), offset))
    return torch.stack(poses)


def scene_points(count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """(N, 3) points in the base frame and their labels: half on the table (-1), the rest in two balls (0, 1)."""
    labels = torch.arange(count) % 4
    labels = torch.where(labels < 2, -1, labels - 2)
    table = torch.cat([torch.rand(count, 2, generator=generator) * 0.4 - 0.2, torch.zeros(count, 1)], dim=1)
    inside = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    ball = BALLS[labels.clamp(min=0)] + BALL_RADIUS * inside * torch.rand(count, 1, generator=generator)
    return torch.where(labels[:, None] < 0, table, ball), labels


@_made_once
def cloud_in_camera(counts: Sequence[int] = (120, 90, 150), *, seed: int = 0) -> PointCloud:
    """A batch that carries one field of every kind.

    ``extra["row"]`` numbers the rows of the whole batch, ``anchor`` repeats the points, ``heading`` the normals, and
    ``source_index`` is ``1000 + 3 * row``; so whatever becomes of a row can be told.
    """
    parts = [scene_points(count, seeded(seed + b)) for b, count in enumerate(counts)]
    in_base, labels = torch.cat([part[0] for part in parts]), torch.cat([part[1] for part in parts])
    total, ptr = len(in_base), ptr_from_counts(counts)
    generator = seeded(seed + 100)
    normals = torch.nn.functional.normalize(torch.randn(total, 3, generator=generator), dim=1)
    pose = base_from_camera(len(counts), seed=seed)
    points = transform_points(in_base, ptr, rigid.invert_rigid(pose))
    row = torch.arange(total)
    return PointCloud(
        points=points,
        ptr=ptr,
        frame_id="camera",
        colors=torch.rand(total, 3, generator=generator),
        normals=normals,
        labels=labels,
        source_index=1000 + 3 * row,
        extra={
            "row": row,
            "weight": torch.rand(total, generator=generator),
            "anchor": points.clone(),
            "heading": normals.clone(),
            "confidence": torch.randint(4, (total,), generator=generator, dtype=torch.uint8),
        },
        kinds={
            "row": Kind.INVARIANT,
            "weight": Kind.INVARIANT,
            "anchor": Kind.POSITION,
            "heading": Kind.DIRECTION,
            "confidence": Kind.MINIMUM,
        },
        viewpoint=torch.zeros(len(counts), 3),
        frames={"camera": torch.eye(4, dtype=torch.float64).repeat(len(counts), 1, 1), "base": pose},
        meta=[{"sample_id": f"sample-{b}", "number": b} for b in range(len(counts))],
        history=[[{"step": "Recorded", "points": count}] for count in counts],
    )


@_made_once
def cloud_in_base(counts: Sequence[int] = (120, 90, 150), *, seed: int = 0) -> PointCloud:
    """The same batch brought into the base frame; its source frame is still the camera's."""
    cloud = cloud_in_camera(counts, seed=seed)
    return cloud.transformed(cloud.frames["base"], frame_id="base")


@_made_once
def frame_with_counts(counts: Sequence[int] = (120, 90), *, seed: int = 0) -> DepthFrame:
    """A capture of 12 x 16 pixels whose view v has ``counts[v]`` readings, at most 192, at random pixels."""
    size, views = (12, 16), len(counts)
    generator = seeded(seed)
    depth = torch.zeros(views, size[0] * size[1])
    for view, count in enumerate(counts):
        chosen = torch.randperm(depth.shape[1], generator=generator)[:count]
        depth[view, chosen] = 0.5 + 0.5 * torch.rand(len(chosen), generator=generator)
    camera = Camera.pinhole(fx=20.0, fy=21.0, cx=7.3, cy=5.8, size=size)
    camera = dataclasses.replace(camera, intrinsics=camera.intrinsics.repeat(views, 1, 1))
    return DepthFrame(
        depth=depth.reshape(views, *size),
        camera=camera,
        colors=torch.randint(256, (views, *size, 3), generator=generator, dtype=torch.uint8),
        labels=torch.randint(-1, 4, (views, *size), generator=generator),
        confidence=torch.randint(4, (views, *size), generator=generator, dtype=torch.uint8),
        mask=torch.rand(views, *size, generator=generator) < 0.7,
        world_from_camera=base_from_camera(views, seed=seed),
        frame_id="base",
        capture_index=3,
        sample_id="capture-3",
        provenance={"sensor": "made up"},
    )


@_made_once
def tabletop_frame(num_views: int = 2, *, seed: int = 0, num_objects: int = 3) -> DepthFrame:
    """A rendered capture of 60 x 80 pixels."""
    return tabletop(seed, num_objects=num_objects, num_views=num_views, size=(60, 80), floor=False).frame


def depth_edges(depth: Tensor, jump: float) -> tuple[Tensor, Tensor]:
    """The depth of the 4-neighbor that differs most, and where it differs by more than ``jump`` of the nearer one."""
    across = facing_depth(depth)
    return across, (across - depth).abs() > jump * torch.minimum(depth, across)


def tree(data: Any) -> Any:
    """All that a structure holds as nested dicts, lists and cloned tensors: a snapshot to compare with later."""
    if isinstance(data, Tensor):
        return data.detach().cpu().clone()
    if dataclasses.is_dataclass(data) and not isinstance(data, type):
        return {field.name: tree(getattr(data, field.name)) for field in dataclasses.fields(data)}
    if isinstance(data, Mapping):
        return {name: tree(value) for name, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [tree(item) for item in data]
    return copy.deepcopy(data)


def differences(a: Any, b: Any, *, tolerance: float = 0.0, path: str = "") -> list[str]:
    """The places where two snapshots differ; with a tolerance, floats may differ by so much."""
    if isinstance(a, Tensor) and isinstance(b, Tensor):
        if a.dtype != b.dtype or a.shape != b.shape:
            return [f"{path}: {a.dtype} {tuple(a.shape)} and {b.dtype} {tuple(b.shape)}"]
        if tolerance and a.is_floating_point():
            worst = float((a - b).abs().max()) if a.numel() else 0.0
            return [] if worst <= tolerance else [f"{path}: differ by {worst}"]
        return [] if torch.equal(a, b) else [f"{path}: tensors differ"]
    if isinstance(a, dict) and isinstance(b, dict):
        if a.keys() != b.keys():
            return [f"{path}: keys {sorted(a)} and {sorted(b)}"]
        return [fault for key in a for fault in differences(a[key], b[key], tolerance=tolerance, path=f"{path}.{key}")]
    if isinstance(a, list) and isinstance(b, list):
        if len(a) != len(b):
            return [f"{path}: {len(a)} and {len(b)} entries"]
        pairs = enumerate(zip(a, b))
        return [fault for i, (x, y) in pairs for fault in differences(x, y, tolerance=tolerance, path=f"{path}[{i}]")]
    if tolerance and isinstance(a, float) and isinstance(b, float):
        return [] if abs(a - b) <= tolerance * max(1.0, abs(a)) else [f"{path}: {a} and {b}"]
    return [] if type(a) is type(b) and a == b else [f"{path}: {a!r} and {b!r}"]


def assert_same(a: Any, b: Any, *, tolerance: float = 0.0) -> None:
    """Compare everything two structures hold, bit for bit unless a tolerance is given."""
    assert not differences(tree(a), tree(b), tolerance=tolerance)


@contextlib.contextmanager
def torch_defaults(*, dtype: torch.dtype | None = None, device: str | None = None) -> Iterator[None]:
    """Another package's choice of torch's global defaults, undone at the end."""
    before = torch.get_default_dtype()
    try:
        if dtype is not None:
            torch.set_default_dtype(dtype)
        if device is not None:
            torch.set_default_device(device)
        yield
    finally:
        torch.set_default_dtype(before)
        torch.set_default_device(None)
