"""Voxels, farthest points and masks: their options beside peers, or beside what a user writes in NumPy or torch.

A peer named "NumPy" or "torch" is the usual recipe in that library, where no package on PyPI has the operation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from timing import Case, installed, same

import pcdata
from pcdata import functional as F

SIZE = 0.003  # metres
SAMPLES = 1024


def cases(cloud: pcdata.PointCloud) -> Iterator[Case]:
    """All of this file."""
    points = cloud.points.contiguous()
    colors = cloud.colors if cloud.colors is not None else torch.rand_like(points)
    yield from voxel_cases(points, colors)
    yield from sampling_cases(points[::8].contiguous(), colors[::8].contiguous())
    yield from mask_cases(points)


# -- voxels -----------------------------------------------------------------------------------------------------------


def numpy_voxels(points: np.ndarray, edges: Any, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number the voxels of a stated grid: the number of each point's, and how many points each has."""
    voxel = np.floor((points.astype(np.float64) - origin) / edges).astype(np.int64)
    voxel -= voxel.min(0)
    size = voxel.max(0) + 1
    _, inverse, counts = np.unique(
        (voxel[:, 0] * size[1] + voxel[:, 1]) * size[2] + voxel[:, 2], return_inverse=True, return_counts=True
    )
    return inverse, counts


def numpy_means(points: np.ndarray, inverse: np.ndarray, counts: np.ndarray) -> np.ndarray:
    return np.stack([np.bincount(inverse, column) / counts for column in points.T], axis=1)


def voxel_cases(points: torch.Tensor, colors: torch.Tensor) -> Iterator[Case]:
    array, count = points.numpy(), len(points)
    origin = np.array([-2.0, -2.0, -0.5])

    def counted(ours: Any, theirs: Any) -> str:
        number = len(theirs.points) if hasattr(theirs, "points") else len(theirs)
        return same_number(len(ours[0]), number, "voxels")

    def numpy(edges: Any, least: int = 1) -> np.ndarray:
        inverse, counts = numpy_voxels(array, edges, origin)
        means = numpy_means(array, inverse, counts)
        return means[counts >= least]

    stated = {"voxel_size": SIZE, "origin": origin.tolist()}
    if installed("open3d"):
        import open3d as o3d

        legacy = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.double().numpy()))
        far = np.abs(array).max(0) + 1.0
        yield Case(
            "voxels, stated origin", count, lambda: F.voxel_downsample(points, **stated), "Open3D",
            lambda: legacy.voxel_down_sample_and_trace(SIZE, origin[:, None], far[:, None].astype(np.float64))[0],
            counted,
        )  # fmt: skip
    yield Case(
        "voxels, stated origin", count, lambda: F.voxel_downsample(points, **stated), "NumPy", lambda: numpy(SIZE),
        counted,
    )  # fmt: skip
    edges = [[0.002, 0.003, 0.005]]
    yield Case(
        "voxels, an edge per axis", count,
        lambda: F.voxel_downsample(points, voxel_size=edges, origin=origin.tolist()), "NumPy",
        lambda: numpy(np.array(edges[0])), counted,
    )  # fmt: skip
    yield Case(
        "voxels, at least 4 points", count, lambda: F.voxel_downsample(points, **stated, min_points=4), "NumPy",
        lambda: numpy(SIZE, least=4), counted,
    )  # fmt: skip
    cloud = pcdata.PointCloud(points=points, ptr=torch.tensor([0, count]), unit="m", frame_id="camera", colors=colors)

    def first() -> Any:
        return np.unique(numpy_voxels(array, SIZE, origin)[0], return_index=True)[1]

    def nearest() -> Any:
        scaled = (array - origin) / SIZE
        apart = np.square(scaled - np.floor(scaled) - 0.5).sum(1)
        order = np.lexsort((apart, own := numpy_voxels(array, SIZE, origin)[0]))
        return order[np.r_[True, np.diff(own[order]) > 0]]

    def highest() -> Any:
        own, number = numpy_voxels(array, SIZE, origin)
        found = np.full((len(number), 3), -np.inf)
        np.maximum.at(found, own, colors.numpy())
        return found

    recipes: dict[str, Callable[[], Any]] = {"first": first, "nearest": nearest}
    for how, recipe in recipes.items():
        step = pcdata.VoxelDownsample(voxel_size=SIZE, origin=tuple(origin), reduce={"points": how})
        yield Case(
            f"voxels, {how} of points, mean of colors", count, lambda step=step: step(cloud), "NumPy, points alone",
            recipe, lambda a, b: same_number(len(a.points), len(b), "voxels"),
        )  # fmt: skip
    step = pcdata.VoxelDownsample(voxel_size=SIZE, origin=tuple(origin), reduce={"colors": "max"})
    yield Case(
        "voxels, max of colors", count, lambda: step(cloud), "NumPy, colors alone", highest,
        lambda a, b: same_number(len(a.points), len(b), "voxels"),
    )  # fmt: skip

    def ours_with_gradient() -> torch.Tensor:
        leaf = points.clone().requires_grad_()
        F.voxel_downsample(leaf, **stated)[0].square().sum().backward()
        return leaf.grad

    def torch_with_gradient() -> torch.Tensor:
        leaf = points.clone().requires_grad_()
        voxel = ((leaf.detach().double() - torch.from_numpy(origin)) / SIZE).floor().long()
        voxel -= voxel.amin(0)
        size = voxel.amax(0) + 1
        _, own, number = torch.unique(
            (voxel[:, 0] * size[1] + voxel[:, 1]) * size[2] + voxel[:, 2], return_inverse=True, return_counts=True
        )
        total = torch.zeros(len(number), 3).index_add(0, own, leaf)
        (total / number[:, None]).square().sum().backward()
        return leaf.grad

    yield Case(
        "voxels, mean and its gradient", count, ours_with_gradient, "torch", torch_with_gradient,
        lambda a, b: f"gradients within {float((a - b).abs().max()):.0e}",
    )  # fmt: skip


def same_number(ours: int, theirs: int, what: str) -> str:
    return f"{ours} {what}" if ours == theirs else f"{ours} and {theirs} {what}"


# -- farthest points --------------------------------------------------------------------------------------------------


def sampling_cases(points: torch.Tensor, colors: torch.Tensor) -> Iterator[Case]:
    count, start = len(points), torch.tensor([len(points) // 2])
    features = torch.cat([points, colors], 1).contiguous()
    labels = points[:, 2].argsort().argsort() * 8 // count  # eight slices of one size

    def picks(ours: Any, theirs: Any) -> str:
        picked = np.asarray(theirs, dtype=np.int64)
        return same(ours[0].numpy(), picked) if picked[0] == int(ours[0][0]) else f"it starts at {picked[0]}"

    if installed("fpsample"):
        import fpsample

        def peer(values: torch.Tensor, number: int, first: int = 0) -> np.ndarray:
            return fpsample.bucket_fps_kdline_sampling(values.numpy(), number, h=7, start_idx=first)

        yield Case(
            "farthest points, start given", count,
            lambda: F.farthest_point_sample(points, num_samples=SAMPLES, start=start), "fpsample",
            lambda: peer(points, SAMPLES, int(start)), picks,
        )  # fmt: skip
        yield Case(
            "farthest points, ratio 1/20", count, lambda: F.farthest_point_sample(points, ratio=0.05), "fpsample",
            lambda: peer(points, -(-count // 20)), picks,
        )  # fmt: skip
        yield Case(
            "farthest points, 6 columns", count, lambda: F.farthest_point_sample(features, num_samples=SAMPLES),
            "fpsample", lambda: peer(features, SAMPLES), picks,
        )  # fmt: skip

        def by_label() -> np.ndarray:
            names = labels.unique()
            return np.concatenate([peer(points[labels == name], SAMPLES // len(names)) for name in names])

        yield Case(
            "farthest points, balanced labels", count,
            lambda: F.farthest_point_sample(points, num_samples=SAMPLES, labels=labels), "fpsample in a loop", by_label,
            lambda a, b: f"{len(a[0])} and {len(b)} picks",
        )  # fmt: skip
        yield from many_sampling_cases(peer)
    if installed("fpsample") and installed("scipy"):
        from scipy.spatial import cKDTree

        def peer_groups() -> np.ndarray:
            picked = fpsample.bucket_fps_kdline_sampling(points.numpy(), SAMPLES, h=7, start_idx=0)
            array = points.numpy()
            return cKDTree(array[picked.astype(np.int64)]).query(array, workers=-1)[0]

        yield Case(
            "farthest points and nearest sample", count,
            lambda: F.farthest_point_groups(points, num_samples=SAMPLES), "fpsample and SciPy", peer_groups,
            lambda a, b: f"farthest from its sample: {float(a[3].max()):.4f} and {b.max():.4f} m",
        )  # fmt: skip


def many_sampling_cases(one: Callable[[torch.Tensor, int], np.ndarray]) -> Iterator[Case]:
    """A batch of small clouds, as PointNet++ samples them: a peer that knows no batches has a loop."""
    clouds, each, number = 128, 3000, 128
    points = torch.rand(clouds * each, 3, generator=torch.Generator().manual_seed(0))
    ptr = torch.arange(clouds + 1) * each

    def compare(_: Any, theirs: Any) -> str:
        start = torch.from_numpy(theirs[:, 0])  # fpsample does not always start where it is told
        ours = F.farthest_point_sample(points, ptr, num_samples=number, start=start)[0].reshape(clouds, number)
        return same((ours - ptr[:-1, None]).numpy(), theirs) + " from their starts on"

    yield Case(
        f"farthest points, {clouds} clouds, {number} of {each} each", len(points),
        lambda: F.farthest_point_sample(points, ptr, num_samples=number), "fpsample in a loop",
        lambda: np.stack([one(cloud, number) for cloud in points.split(each)]).astype(np.int64), compare,
    )  # fmt: skip


# -- masks ------------------------------------------------------------------------------------------------------------


def mask_cases(points: torch.Tensor) -> Iterator[Case]:
    count, array = len(points), points.numpy()
    lower, upper = (-0.3, -0.2, 0.2), (0.3, 0.2, 0.8)
    low, high = np.array(lower, dtype=np.float32), np.array(upper, dtype=np.float32)
    yield Case(
        "box mask", count, lambda: F.box_mask(points, lower=lower, upper=upper), "NumPy",
        lambda: ((array >= low) & (array <= high)).all(1), lambda a, b: same(a.numpy(), b),
    )  # fmt: skip
    turn = torch.linspace(0, 6.2, 32)
    radius = 0.2 + 0.1 * (5 * turn).sin()
    polygon = torch.stack([radius * turn.cos(), radius * turn.sin()], 1).double()
    flat = points[:, :2].contiguous()
    twice = points[torch.arange(count) // 2].contiguous()
    if installed("open3d"):
        import open3d as o3d

        def legacy(tensor: torch.Tensor) -> Any:
            return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(tensor.double().numpy()))

        volume = o3d.visualization.SelectionPolygonVolume()
        volume.orthogonal_axis = "Z"
        volume.axis_min, volume.axis_max = -100, 100
        corners = torch.cat([polygon, torch.zeros(len(polygon), 1, dtype=torch.float64)], 1)
        volume.bounding_polygon = o3d.utility.Vector3dVector(corners.numpy())
        whole = legacy(points)
        box = o3d.geometry.AxisAlignedBoundingBox(np.array(lower), np.array(upper))
        yield Case(
            "box mask", count, lambda: F.box_mask(points, lower=lower, upper=upper), "Open3D",
            lambda: box.get_point_indices_within_bounding_box(whole.points),
            lambda a, b: same_number(int(a.sum()), len(b), "inside"),
        )  # fmt: skip
        yield Case(
            "polygon mask, 32 corners", count, lambda: F.polygon_mask(flat, polygon=polygon), "Open3D, points picked",
            lambda: volume.crop_point_cloud(whole), lambda a, b: same_number(int(a.sum()), len(b.points), "inside"),
        )  # fmt: skip
        tensor = o3d.t.geometry.PointCloud(o3d.core.Tensor(twice.numpy()))
        yield Case(
            "repeated points", count, lambda: F.duplicate_mask(twice), "Open3D tensor",
            lambda: tensor.remove_duplicated_points()[1].numpy(),
            lambda a, b: same_number(int((~a).sum()), int(b.sum()), "kept"),
        )  # fmt: skip
    yield Case(
        "repeated points", count, lambda: F.duplicate_mask(twice), "NumPy",
        lambda: np.unique(twice.numpy(), axis=0, return_index=True)[1],
        lambda a, b: same_number(int((~a).sum()), len(b), "kept"),
    )  # fmt: skip
