"""One or more instances of every registered transform, with input that it can work on.

A new transform joins the contract suite by an entry here; without one the suite fails.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from pcdata import transforms as T
from pcdata.geometry.lens_models import lens_row
from pcdata.structures import NORMALIZED, DepthFrame, ImageLayout, PointCloud
from tests.factories import cloud_in_base, cloud_in_camera, frame_with_counts, tabletop_frame

QUARTER_TURN = ((0.0, -1.0, 0.0, 0.1), (1.0, 0.0, 0.0, -0.2), (0.0, 0.0, 1.0, 0.3), (0.0, 0.0, 0.0, 1.0))
VIEW = {
    "frame": "base",
    "frame_from_camera": ((0.0, -1.0, 0.0, 0.1), (1.0, 0.0, 0.0, -0.1), (0.0, 0.0, 1.0, -0.3), (0.0, 0.0, 0.0, 1.0)),
    **{"fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5, "size": (24, 32)},
}
BOX = {"lower": (-0.15, -0.15, -0.01), "upper": (0.15, 0.15, 0.2)}


@dataclass(frozen=True)
class Example:
    """A transform, and how to make input of given counts for it."""

    transform: T.Transform
    make: Callable[[Sequence[int]], PointCloud | DepthFrame] = cloud_in_base
    displacement: float = 0.0  # metres that a point may move beyond what source_from_cloud undoes (noise, averages)


def tabletop_with_counts(counts: Sequence[int]) -> DepthFrame:
    """A rendered capture with as many views as there are counts, each with confidences."""
    frame = tabletop_frame(len(counts))
    return replace(frame, confidence=3 - (frame.depth == 0).to(torch.uint8))


def normalized_cloud(counts: Sequence[int]) -> PointCloud:
    """The batch in a unit that is half a metre; its clouds may have no extent."""
    cloud = cloud_in_base(counts)
    return cloud.transformed(torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0])).repeat(len(counts), 1, 1), unit=NORMALIZED)


def cloud_with_flaws(counts: Sequence[int]) -> PointCloud:
    """The batch with some points at infinity."""
    cloud = cloud_in_base(counts)
    weight = cloud.extra["weight"].clone()
    weight[2::7] = math.inf
    return cloud.with_fields(weight=weight)


def cloud_with_repeats(counts: Sequence[int]) -> PointCloud:
    """The batch with some points twice, as other rows."""
    cloud = cloud_in_base(counts)
    rows = torch.arange(cloud.num_points)
    first = torch.repeat_interleave(cloud.ptr[:-1], cloud.counts)
    points = cloud.points[torch.where((rows - first) % 5 == 4, rows - 1, rows)]
    return cloud.with_fields(points=points, anchor=points)


def _of(*transforms: T.Transform, **others: object) -> list[Example]:
    return [Example(transform, **others) for transform in transforms]  # type: ignore[arg-type]


def _frame_with_a_lens(counts: Sequence[int] = (120, 90), *, seed: int = 0) -> DepthFrame:
    frame = frame_with_counts(counts, seed=seed)
    lens = torch.tensor([lens_row("example", "fisheye", [-0.01, 0.04, -0.03, 0.006])], dtype=torch.float64)
    return replace(frame, camera=replace(frame.camera, distortion=lens.repeat(len(counts), 1)))


def _organized(counts: Sequence[int]) -> PointCloud:
    """The batch on images of 16 x 16 pixels, in their order."""
    cloud = cloud_in_base(counts)
    intrinsics = torch.tensor([[60.0, 0.0, 7.5], [0.0, 61.0, 7.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    pixels = torch.cat([torch.arange(count) for count in counts])
    layout = ImageLayout(size=(16, 16), intrinsics=intrinsics.repeat(len(counts), 1, 1))
    return replace(cloud, source_index=pixels, layout=layout)


EXAMPLES: dict[str, list[Example]] = {
    "Center": _of(T.Center()),
    "ClusterObjects": [
        *_of(
            T.ClusterObjects(eps=0.03, min_points=4, min_size=5),
            T.ClusterObjects(eps=0.03, min_points=4, min_size=5, max_size=300, keep="all"),
            T.ClusterObjects(eps=0.03, min_points=4, min_area=1e-5, max_area=0.5, keep="all"),
        ),
        *_of(
            T.ClusterObjects(eps=0.1, by="image", min_area=1e-5, max_area=50.0, keep="all"),
            T.ClusterObjects(eps=0.1, by="image", min_size=1, keep="all", split_touching=True, use_color=True),
            make=_organized,
        ),
    ],
    "CompleteDepth": _of(
        T.CompleteDepth(completion="smooth"), T.CompleteDepth(completion="nearest", reach=1), make=frame_with_counts
    ),
    "Compose": [
        Example(
            T.Compose([T.CropWorkspace(frame="base", **BOX), T.NormalizeUnitSphere(), T.RandomRotation(axis=None)])
        ),
        Example(T.Compose([T.ToFrame(frame="base"), T.RemovePlane(), T.Center()]), cloud_in_camera),
        Example(
            T.Compose([T.RandomTranslation(), T.RandomJitter(clip=0.004), T.RandomSample(num_points=20)]),
            displacement=0.004 * math.sqrt(3),
        ),
    ],
    "CropCenter": _of(T.CropCenter(size=(5, 7)), make=frame_with_counts),
    "CropFrustum": _of(
        T.CropFrustum(**VIEW, near=0.2, far=0.45),
        T.CropFrustum(**VIEW, lens="fisheye", distortion=(0.01, 0.02, 0.0, 0.0), invert=True),
    ),
    "CropPolygon": _of(
        T.CropPolygon(frame="base", polygon=((-0.2, -0.2), (0.2, -0.2), (0.2, 0.2), (0.0, 0.0), (-0.2, 0.2))),
        T.CropPolygon(frame="base", polygon=((0, 0), (0.1, 0), (0, 0.1)), axis="x", low=-0.2, high=0.4, invert=True),
    ),
    "CropWorkspace": _of(
        T.CropWorkspace(frame="base", **BOX, invert=True, max_drop=1.0, drop_alarm="warn"),
        T.CropWorkspace(frame="base", **BOX),
        T.CropWorkspace(frame="base", frame_from_box=QUARTER_TURN, lower=(0.1, 0.0, -0.5), upper=(0.5, 0.3, 0.5)),
    ),
    "DecimateDepth": _of(
        T.DecimateDepth(factor=2),
        T.DecimateDepth(factor=5, max_jump=0.5),
        T.DecimateDepth(factor=3, rule="mean"),
        make=frame_with_counts,
    ),
    "Deproject": _of(T.Deproject(), make=frame_with_counts),
    "DescribeShape": _of(
        T.DescribeShape(radius=0.05),
        T.DescribeShape(features=("linearity", "planarity"), radius=None, max_neighbors=9),
    ),
    "DropNonFinite": _of(T.DropNonFinite(fields=("points", "weight")), make=cloud_with_flaws),
    "EstimateNormals": _of(
        T.EstimateNormals(radius=0.05), T.EstimateNormals(radius=None, max_neighbors=8, orient="none")
    ),
    "FarthestPointSample": _of(
        T.FarthestPointSample(num_points=32),
        *(T.FarthestPointSample(num_points=100, if_short=how) for how in ("repeat", "tile", "zeros", "keep")),
        T.FarthestPointSample(num_points=20, start=70, color_weight=0.1, balance_labels=True),
    ),
    "FillHoles": _of(
        *(T.FillHoles(rule=rule, max_distance=2) for rule in ("left", "farthest", "nearest")),
        T.FillHoles(max_size=1),
        make=frame_with_counts,
    ),
    "FuseTSDF": _of(
        T.FuseTSDF(frame="base", voxel_size=0.02),
        T.FuseTSDF(
            frame="base",
            voxel_size=0.02,
            truncation=0.05,
            weighting="angle",
            carve="everywhere",
            min_confidence="completed",
        ),
        make=tabletop_with_counts,
    ),
    "InpaintDepth": _of(T.InpaintDepth(), T.InpaintDepth(max_distance=1), make=frame_with_counts),
    "KeepConfidence": _of(T.KeepConfidence(), T.KeepConfidence(minimum="completed")),
    "KeepValues": _of(T.KeepValues(values=(0, 1)), T.KeepValues(field="weight", low=0.2, high=0.9, invert=True)),
    "MapLabels": _of(T.MapLabels(mapping=((0, 7), (1, 0))), T.MapLabels(mapping=((1, 3), (2, 3)), others=-1)),
    "MarkUnreliableDepth": _of(
        T.MarkUnreliableDepth(sensor="realsense_d435"),
        T.MarkUnreliableDepth(sensor="kinect_v1", enclosed=False),
        T.MarkUnreliableDepth(sensor="photoneo_phoxi_m", rough=False),
        make=frame_with_counts,
    ),
    "MaskDepth": _of(
        T.MaskDepth(near=0.6, far=0.9),
        T.MaskDepth(use_mask=False, drop_labels=(0, 2)),
        T.MaskDepth(require_mask=True),
        T.MaskDepth(min_confidence="completed"),
        make=frame_with_counts,
    ),
    "MergeViews": _of(T.MergeViews(), T.MergeViews(face_cameras=False)),
    "NormalizeUnitSphere": _of(T.NormalizeUnitSphere()),
    "NormalizeWorkspace": _of(T.NormalizeWorkspace(frame="base", **BOX)),
    "RandomApply": [
        Example(T.RandomApply(step=T.RandomRotation())),
        *_of(T.RandomApply(step=T.RandomSensorNoise(sensor="realsense_d435")), make=frame_with_counts),
        Example(T.RandomApply(step=T.RandomPointDropout(), probability=0.8)),
        Example(T.RandomApply(step=T.Compose([T.RandomFlip(), T.RandomScale()]), probability=0.7)),
        Example(T.RandomApply(step=T.RemovePlane(), probability=0.4)),
    ],
    "RandomColorJitter": _of(T.RandomColorJitter(), T.RandomColorJitter(brightness=0.9, hue=0.5)),
    "RandomColorDrop": _of(T.RandomColorDrop(), T.RandomColorDrop(probability=0.5, color=(0.5, 0.5, 0.5))),
    "RandomColumn": _of(T.RandomColumn(size=0.15, min_points=3)),
    "RandomCuboid": _of(T.RandomCuboid(), T.RandomCuboid(low=0.1, high=(0.2, 0.3, 0.4), keep="inside")),
    "RandomElastic": [
        Example(T.RandomElastic(), displacement=0.01 * math.sqrt(3)),
        Example(T.RandomElastic(wavelength=0.5, max_offset=0.05), displacement=0.05 * math.sqrt(3)),
    ],
    "RandomFarthestPointSample": _of(
        T.RandomFarthestPointSample(num_points=32),
        T.RandomFarthestPointSample(num_points=100, if_short="repeat", color_weight=0.1, balance_labels=True),
    ),
    "RandomFlip": _of(T.RandomFlip(), T.RandomFlip(probability=(0.5, 0.5, 0.5), about="centroid")),
    "RandomJitter": [
        Example(T.RandomJitter(), displacement=0.005 * math.sqrt(3)),
        Example(T.RandomJitter(sigma=0.0001, clip=None), displacement=0.0001 * 8 * math.sqrt(3)),
        Example(T.RandomJitter(sigma=(0.0, 0.001, 0.002), clip=0.004), displacement=0.006),
        Example(T.RandomJitter(along_ray=True, clip=0.004), displacement=0.004),
    ],
    "RandomOcclusion": _of(T.RandomOcclusion(), T.RandomOcclusion(low=0.5, high=1.0)),
    "RandomOneOf": [
        Example(T.RandomOneOf(steps=[T.RandomRotation(), T.RandomScale()])),
        *_of(
            T.RandomOneOf(steps=[T.RandomTurnDepth(quarter_turns=(1, 3)), T.MaskDepth(near=0.7), T.Compose([])]),
            make=frame_with_counts,
        ),
        Example(
            T.RandomOneOf(
                steps=[T.RandomPointDropout(), T.Compose([]), T.Compose([T.RandomRotation(), T.RemovePlane()])],
                weights=(2.0, 1.0, 3.0),
            )
        ),
    ],
    "RandomPointCount": _of(
        T.RandomPointCount(num_points=50),
        T.RandomPointCount(num_points=100, spread=0.5, if_short="repeat"),
        T.RandomPointCount(num_points=100, spread=0.5, if_short="zeros"),
    ),
    "RandomPointDropout": _of(T.RandomPointDropout(), T.RandomPointDropout(low=0.5, high=1.0)),
    "RandomRotation": _of(
        T.RandomRotation(),
        T.RandomRotation(axis=(1.0, 2.0, -0.5), degrees=30.0, about="centroid"),
        T.RandomRotation(axis=None, about="centroid"),
        T.RandomRotation(degrees=(-10.0, 40.0), about=(0.1, 0.0, -0.2)),
        T.RandomRotation(degrees_xyz=((-5.0, 5.0), (0.0, 0.0), (10.0, 180.0))),
    ),
    "RandomSample": _of(
        T.RandomSample(num_points=32),
        *(T.RandomSample(num_points=100, if_short=how) for how in ("repeat", "tile", "zeros", "keep")),
        T.RandomSample(num_points=100, with_replacement=True),
    ),
    "RandomScale": _of(
        T.RandomScale(),
        T.RandomScale(low=0.5, high=2.0, about="centroid", per_axis=True),
        T.RandomScale(low=(0.9, 1.0, 1.0), high=1.5, per_axis=True),
    ),
    "RandomSensorNoise": _of(
        T.RandomSensorNoise(sensor="realsense_d435"),
        T.RandomSensorNoise(sensor="azure_kinect_nfov", strength=0.5, edge_dropout=0.1, grazing_degrees=70.0),
        make=frame_with_counts,
    ),
    "RandomShear": _of(
        T.RandomShear(),
        T.RandomShear(low=0.1, high=0.3, about="centroid"),
        T.RandomShear(
            low=((0.0, 0.0, -0.4), (0.0, 0.0, 0.2), (0.0, 0.0, 0.0)),
            high=((0.0, 0.0, 0.6), (0.1, 0.0, 0.2), (0.0, 0.0, 0.0)),
        ),
    ),
    "RandomShuffle": _of(T.RandomShuffle()),
    "RandomTranslation": _of(
        T.RandomTranslation(),
        T.RandomTranslation(max_offset=(0.1, 0.0, 0.3)),
        T.RandomTranslation(min_offset=0.1, max_offset=0.2),
    ),
    "RandomTurnDepth": _of(T.RandomTurnDepth(), T.RandomTurnDepth(quarter_turns=(1, 3)), make=frame_with_counts),
    "RandomVoxelSample": _of(
        T.RandomVoxelSample(voxel_size=0.05),
        T.RandomVoxelSample(voxel_size=(0.05, 0.1, 0.3), origin=(0.02, 0.0, 0.01), min_points=2),
    ),
    "RemoveDuplicates": _of(T.RemoveDuplicates(), make=cloud_with_repeats),
    "BilateralFilterDepth": _of(
        T.BilateralFilterDepth(),
        T.BilateralFilterDepth(reach=1, sigma_pixels=0.7, sigma_depth=0.2, max_jump=0.5),
        make=frame_with_counts,
    ),
    "MedianFilterDepth": _of(T.MedianFilterDepth(), T.MedianFilterDepth(reach=2, max_jump=0.5), make=frame_with_counts),
    "RemoveFlyingPixels": _of(
        T.RemoveFlyingPixels(),
        T.RemoveFlyingPixels(tolerance=0.2, min_neighbors=2),
        make=frame_with_counts,
    ),
    "RemoveHiddenPoints": _of(
        T.RemoveHiddenPoints(), T.RemoveHiddenPoints(viewpoint=(0.5, 0.1, 0.9), frame="base", radius_factor=10.0)
    ),
    "RemovePlane": _of(
        T.RemovePlane(distance=0.005),
        T.RemovePlane(up=(0.0, 0.1, 1.0), frame="base", max_tilt=0.2, keep="above", num_hypotheses=200, tilt_alarm=0.2),
        T.RemovePlane(up=(0.0, 0.0, 1.0), frame="base", keep="over", max_height=0.2, margin=0.01, tilt_alarm=None),
        T.RemovePlane(which="supporting", cut="measured", probability=0.999),
    ),
    "RemoveRadiusOutliers": _of(T.RemoveRadiusOutliers(min_neighbors=2, radius=0.03)),
    "RemoveStatisticalOutliers": _of(T.RemoveStatisticalOutliers(num_neighbors=8, std_ratio=1.5)),
    "ResizeDepth": _of(
        T.ResizeDepth(size=(7, 9), max_jump=None),
        T.ResizeDepth(size=(24, 31), max_jump=0.3),
        make=frame_with_counts,
    ),
    "ShiftToOrigin": _of(T.ShiftToOrigin(anchor="corner"), T.ShiftToOrigin(anchor="floor")),
    "SpatialFilterDepth": _of(
        T.SpatialFilterDepth(),
        T.SpatialFilterDepth(alpha=0.3, delta=5.0, iterations=1, hole_fill_radius=2, baseline=0.1),
        make=frame_with_counts,
    ),
    "SplitObjects": _of(T.SplitObjects()),
    "ToFrame": [
        Example(T.ToFrame(frame="base"), cloud_in_camera),
        Example(T.ToFrame(frame="camera")),
        Example(T.ToFrame(frame="table", start="base", matrix=QUARTER_TURN)),
    ],
    "TurnDepth": _of(T.TurnDepth(), T.TurnDepth(quarter_turns=2), make=frame_with_counts),
    "Undistort": _of(T.Undistort(), T.Undistort(rule="surface", zoom=0.8), make=_frame_with_a_lens),
    "VoxelDownsample": [
        Example(T.VoxelDownsample(voxel_size=0.02), displacement=0.02 * math.sqrt(3)),
        Example(
            T.VoxelDownsample(
                voxel_size=(0.03, 0.05, 0.2), origin=(0.01, 0.0, -0.3), min_points=2, reduce={"colors": "max"}
            ),
            displacement=0.21,
        ),
        Example(
            T.VoxelDownsample(
                voxel_size=0.05, reduce=dict.fromkeys(("points", "anchor", "labels", "weight", "normals"), "nearest")
            ),
            displacement=0.05 * math.sqrt(3),
        ),
        Example(T.VoxelDownsample(num_points=40), displacement=0.1 * math.sqrt(3)),
        Example(
            T.VoxelDownsample(voxel_size=0.1, unit="normalized"), normalized_cloud, displacement=0.1 * math.sqrt(3)
        ),
    ],
    "VoxelSample": [
        *_of(
            T.VoxelSample(voxel_size=0.05),
            T.VoxelSample(voxel_size=(0.05, 0.1, 0.3), origin=(0.02, 0.0, 0.01), min_points=2, keep="nearest"),
        ),
        Example(T.VoxelSample(voxel_size=0.2, unit="normalized"), normalized_cloud),
    ],
}

ALL = [example for examples in EXAMPLES.values() for example in examples]
NAMES = [f"{name}-{i}" for name, examples in EXAMPLES.items() for i in range(len(examples))]
