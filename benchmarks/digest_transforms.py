"""Digests of every registered transform: one cloud, a batch of two, and real captures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from digest_inputs import (
    COUNTS,
    base_cloud,
    camera_cloud,
    normalized_cloud,
    rendered,
    small_frame,
    with_confidence,
    with_lens,
)
from digest_names import chain, randomly, run, step, takes_frames, transform_names
from digest_real import real_clouds, real_folder, real_frames

TURN = ((0.0, -1.0, 0.0, 0.1), (1.0, 0.0, 0.0, -0.2), (0.0, 0.0, 1.0, 0.3), (0.0, 0.0, 0.0, 1.0))
BOX: dict[str, Any] = {"lower": (-0.15, -0.15, -0.01), "upper": (0.15, 0.15, 0.2)}
WIDE: dict[str, Any] = {"lower": (-3.0, -3.0, -3.0), "upper": (3.0, 3.0, 3.0)}
SHORT = ("repeat", "tile", "zeros", "keep")


@dataclass(frozen=True)
class Example:
    """A step, and how to make input of given counts for it; ``real`` also runs it on real captures."""

    make_step: Callable[[], Any]
    make: Callable[..., Any] | None = None
    real: bool = True


def _of(name: str, *fields: dict[str, Any], **others: Any) -> list[Example]:
    return [Example(lambda given=given: step(name, **given), **others) for given in fields]


def _table(counts: tuple[int, ...] = COUNTS, seed: int = 0) -> Any:
    return with_confidence(rendered(len(counts), seed))


def _through_a_lens(counts: tuple[int, ...] = COUNTS, seed: int = 0) -> Any:
    return with_lens(small_frame(counts, seed))


EXAMPLES: dict[str, list[Example]] = {
    "Center": _of("Center", {}),
    "ClusterObjects": _of(
        "ClusterObjects",
        {"eps": 0.03, "min_points": 4, "min_size": 5},
        {"eps": 0.03, "min_points": 4, "min_size": 5, "max_size": 300, "keep": "all"},
        {"eps": 0.03, "min_points": 4, "min_area": 1e-5, "max_area": 0.5, "keep": "all"},
    ),
    "CompleteDepth": _of("CompleteDepth", {"completion": "smooth"}, {"completion": "nearest", "reach": 1}),
    "Compose": [
        Example(
            lambda: chain(
                step("CropWorkspace", frame="base", **WIDE),
                step("NormalizeUnitSphere"),
                step("RandomRotation", axis=None),
            )
        ),
        Example(
            lambda: chain(step("ToFrame", frame="base"), step("RemovePlane"), step("Center")), camera_cloud, real=False
        ),
        Example(
            lambda: chain(
                step("RandomTranslation"), step("RandomJitter", clip=0.004), step("RandomSample", num_points=20)
            )
        ),
        Example(
            lambda: chain(
                step("MaskDepth", near=0.3, far=3.0),
                step("Deproject"),
                step("CropWorkspace", frame="camera", **WIDE),
                step("VoxelDownsample", voxel_size=0.02),
                step("FarthestPointSample", num_points=256, if_short="repeat"),
                step("EstimateNormals", radius=0.05),
            ),
            _table,
        ),
    ],
    "CropCenter": _of("CropCenter", {"size": (5, 7)}),
    "CropWorkspace": _of(
        "CropWorkspace",
        {"frame": "base", **BOX},
        {"frame": "base", "frame_from_box": TURN, "lower": (0.1, 0.0, -0.5), "upper": (0.5, 0.3, 0.5)},
        {"frame": "base", "lower": (-0.3, -0.3, -1.0), "upper": (0.5, 0.5, 1.0)},
    ),
    "DecimateDepth": _of("DecimateDepth", {"factor": 2}, {"factor": 5, "max_jump": 0.5}, {"factor": 3, "rule": "mean"}),
    "Deproject": _of("Deproject", {}),
    "CropFrustum": _of(
        "CropFrustum",
        {
            **{"frame": "base", "frame_from_camera": TURN, "fx": 20.0, "fy": 21.0, "cx": 7.5, "cy": 5.5},
            **{"size": (12, 16), "near": 0.01, "far": 2.0},
        },
    ),
    "RemoveHiddenPoints": _of("RemoveHiddenPoints", {}),
    "CropPolygon": _of("CropPolygon", {"frame": "base", "polygon": ((-0.2, -0.2), (0.2, -0.2), (0.2, 0.2), (0, 0))}),
    "DropNonFinite": _of("DropNonFinite", {}),
    "KeepValues": _of("KeepValues", {"values": (0, 1)}),
    "MapLabels": _of("MapLabels", {"mapping": ((0, 7), (1, 0)), "others": -1}),
    "RemoveDuplicates": _of("RemoveDuplicates", {}),
    "DescribeShape": _of("DescribeShape", {"radius": 0.05, "features": ("planarity", "surface_variation")}),
    "EstimateNormals": _of("EstimateNormals", {"radius": 0.05}, {"max_neighbors": 8, "orient": "none"}),
    "FarthestPointSample": _of(
        "FarthestPointSample", {"num_points": 32}, *({"num_points": 140, "if_short": how} for how in SHORT)
    ),
    "FillHoles": _of(
        "FillHoles", *({"rule": rule, "max_distance": 2} for rule in ("left", "farthest", "nearest")), {"max_size": 1}
    ),
    "FuseTSDF": _of(
        "FuseTSDF",
        {"frame": "base", "voxel_size": 0.02},
        {
            **{"frame": "base", "voxel_size": 0.02, "truncation": 0.05, "weighting": "angle"},
            **{"carve": "everywhere", "min_confidence": "completed"},
        },
        make=_table,
    ),
    "InpaintDepth": _of("InpaintDepth", {}, {"max_distance": 1}, real=False),
    "KeepConfidence": _of("KeepConfidence", {}, {"minimum": "completed"}, real=False),
    "MarkUnreliableDepth": _of(
        "MarkUnreliableDepth",
        {"sensor": "realsense_d435"},
        {"sensor": "kinect_v1", "enclosed": False},
        {"sensor": "photoneo_phoxi_m", "rough": False},
    ),
    "MaskDepth": [
        *_of("MaskDepth", {"near": 0.6, "far": 0.9}),
        *_of(
            "MaskDepth",
            {"use_mask": False, "drop_labels": (0, 2)},
            {"min_confidence": "completed"},
            {"require_mask": True},
            real=False,
        ),
    ],
    "MergeViews": _of("MergeViews", {}, {"face_cameras": False}),
    "NormalizeUnitSphere": _of("NormalizeUnitSphere", {}),
    "NormalizeWorkspace": _of("NormalizeWorkspace", {"frame": "base", **BOX}),
    "RandomApply": [
        Example(lambda: randomly(step("RandomRotation"))),
        Example(lambda: randomly(step("RandomPointDropout"), probability=0.8)),
        Example(lambda: randomly(chain(step("RandomFlip"), step("RandomScale", low=0.7)), probability=0.7)),
    ],
    "RandomColorJitter": _of("RandomColorJitter", {}, {"brightness": 0.9, "hue": 0.5}),
    "RandomColumn": _of("RandomColumn", {"size": 0.15, "min_points": 3}),
    "RandomColorDrop": _of("RandomColorDrop", {"probability": 0.5}),
    "RandomCuboid": _of("RandomCuboid", {}, {"keep": "inside", "low": 0.1, "high": (0.2, 0.3, 0.4)}),
    "RandomOcclusion": _of("RandomOcclusion", {}),
    "RandomOneOf": [
        Example(lambda: step("RandomOneOf", steps=[step("RandomFlip"), step("RandomPointDropout")], weights=(1.0, 2.0)))
    ],
    "RandomShuffle": _of("RandomShuffle", {}),
    "RandomShear": _of("RandomShear", {}, {"low": 0.1, "high": 0.3, "about": "centroid"}),
    "RandomTurnDepth": _of("RandomTurnDepth", {}),
    "TurnDepth": _of("TurnDepth", {}, {"quarter_turns": 2}),
    "RandomElastic": _of("RandomElastic", {}),
    "RandomFarthestPointSample": _of("RandomFarthestPointSample", {"num_points": 32, "color_weight": 0.1}),
    "RandomFlip": _of("RandomFlip", {}, {"probability": (0.5, 0.5, 0.5), "about": "centroid"}),
    "RandomJitter": _of("RandomJitter", {}, {"sigma": 0.0001, "clip": None}),
    "RandomPointCount": _of(
        "RandomPointCount",
        {"num_points": 50},
        {"num_points": 100, "spread": 0.5, "if_short": "repeat"},
        {"num_points": 100, "spread": 0.5, "if_short": "zeros"},
    ),
    "RandomPointDropout": _of("RandomPointDropout", {}, {"low": 0.5, "high": 1.0}),
    "RandomRotation": _of(
        "RandomRotation",
        {},
        {"axis": (1.0, 2.0, -0.5), "degrees": 30.0, "about": "centroid"},
        {"axis": None, "about": "centroid"},
    ),
    "RandomSample": _of(
        "RandomSample",
        {"num_points": 32},
        *({"num_points": 140, "if_short": how} for how in SHORT),
        {"num_points": 100, "with_replacement": True},
    ),
    "RandomScale": _of("RandomScale", {}, {"low": 0.5, "high": 2.0, "about": "centroid", "per_axis": True}),
    "RandomSensorNoise": _of(
        "RandomSensorNoise",
        {"sensor": "realsense_d435"},
        {"sensor": "azure_kinect_nfov", "strength": 0.5, "edge_dropout": 0.1, "grazing_degrees": 70.0},
    ),
    "RandomTranslation": _of("RandomTranslation", {}, {"max_offset": (0.1, 0.0, 0.3)}),
    "RandomVoxelSample": _of("RandomVoxelSample", {"voxel_size": 0.05}),
    "BilateralFilterDepth": _of("BilateralFilterDepth", {}, {"reach": 1, "sigma_depth": 0.2, "max_jump": 0.5}),
    "MedianFilterDepth": _of("MedianFilterDepth", {}, {"reach": 2, "max_jump": 0.5}),
    "RemoveFlyingPixels": _of("RemoveFlyingPixels", {}, {"tolerance": 0.2, "min_neighbors": 2}),
    "RemovePlane": _of(
        "RemovePlane",
        {"distance": 0.005},
        {
            **{"up": (0.0, 0.1, 1.0), "frame": "base", "max_tilt": 0.2, "keep": "above"},
            **{"num_hypotheses": 200, "seed": 4},
        },
        {"up": (0.0, 0.3, 1.0), "frame": "base", "max_tilt": 1.5, "keep": "above"},
    ),
    "RemoveRadiusOutliers": _of("RemoveRadiusOutliers", {"min_neighbors": 2, "radius": 0.03}),
    "RemoveStatisticalOutliers": _of("RemoveStatisticalOutliers", {"num_neighbors": 8, "std_ratio": 1.5}),
    "ResizeDepth": _of("ResizeDepth", {"size": (7, 9), "max_jump": None}, {"size": (24, 31), "max_jump": 0.3}),
    "ShiftToOrigin": _of("ShiftToOrigin", {"anchor": "corner"}, {"anchor": "floor"}),
    "SpatialFilterDepth": _of(
        "SpatialFilterDepth",
        {},
        {"alpha": 0.3, "delta": 5.0, "iterations": 1, "hole_fill_radius": 2, "baseline": 0.1},
    ),
    "SplitObjects": _of("SplitObjects", {}, real=False),
    "ToFrame": [
        *_of("ToFrame", {"frame": "base"}, make=camera_cloud, real=False),
        *_of("ToFrame", {"frame": "camera"}, {"frame": "table", "start": "base", "matrix": TURN}),
    ],
    "Undistort": _of("Undistort", {}, {"rule": "surface", "zoom": 0.7, "max_jump": 0.3}, make=_through_a_lens),
    "VoxelDownsample": [
        *_of("VoxelDownsample", {"voxel_size": 0.02}, {"num_points": 40}),
        *_of("VoxelDownsample", {"voxel_size": 0.1, "unit": "normalized"}, make=normalized_cloud, real=False),
    ],
    "VoxelSample": [
        *_of("VoxelSample", {"voxel_size": 0.05}),
        *_of("VoxelSample", {"voxel_size": 0.2, "unit": "normalized"}, make=normalized_cloud, real=False),
    ],
}


def without_example() -> list[str]:
    """Return the transforms that have no example, and the examples of transforms that are no more."""
    return sorted(set(transform_names()) ^ set(EXAMPLES))


def cases() -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield ``transform/NAME/number/input`` for one cloud, a batch of two, and real captures."""
    for name, examples in EXAMPLES.items():
        for number, example in enumerate(examples):
            yield from _cases_of(f"transform/{name}/{number}", example)


def _cases_of(key: str, example: Example) -> Iterator[tuple[str, Callable[[], Any]]]:
    made = example.make_step()
    on_frames = takes_frames(made)
    make = example.make or (small_frame if on_frames else base_cloud)
    yield f"{key}/synthetic one", lambda: run(made, make((120,), 7))
    yield f"{key}/synthetic two", lambda: run(made, make(COUNTS, 0), 1)
    if not example.real or real_folder() is None:
        return
    names = ("graspnet", "seven_scenes two") if on_frames else ("graspnet", "osd", "seven_scenes two")
    for name in names:
        yield f"{key}/{name}", lambda name=name: run(made, (real_frames if on_frames else real_clouds)()[name], 2)
