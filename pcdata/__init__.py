"""pcdata: from raw depth frames to point clouds a robot-learning model can train on.

Importing pcdata is cheap: every public name is loaded when it is first used.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

_HOMES = {
    "pcdata.structures": [
        "Calibration",
        "Camera",
        "Confidence",
        "DepthFrame",
        "Episode",
        "Kind",
        "PaddedClouds",
        "PointCloud",
        "Signal",
        "SurfaceMesh",
        "TSDFVolume",
        "register_to_color",
        "render",
    ],
    "pcdata.sensors": ["SensorProfile", "sensor_profile"],
    "pcdata.transforms": [
        "Center",
        "ClusterObjects",
        "CompleteDepth",
        "Compose",
        "CropCenter",
        "CropFrustum",
        "CropPolygon",
        "CropWorkspace",
        "DecimateDepth",
        "Deproject",
        "DescribeShape",
        "DropNonFinite",
        "EstimateNormals",
        "FarthestPointSample",
        "FillHoles",
        "FuseTSDF",
        "KeepConfidence",
        "KeepValues",
        "InpaintDepth",
        "MapLabels",
        "MarkUnreliableDepth",
        "MaskDepth",
        "MergeViews",
        "NormalizeUnitSphere",
        "NormalizeWorkspace",
        "RandomApply",
        "RandomColorDrop",
        "RandomColorJitter",
        "RandomColumn",
        "RandomCuboid",
        "BilateralFilterDepth",
        "MedianFilterDepth",
        "RandomElastic",
        "RandomFarthestPointSample",
        "RandomFlip",
        "RandomJitter",
        "RandomOcclusion",
        "RandomOneOf",
        "RandomPointCount",
        "RandomPointDropout",
        "RandomRotation",
        "RandomSample",
        "RandomScale",
        "RandomSensorNoise",
        "RandomShear",
        "RandomShuffle",
        "RandomTranslation",
        "RandomTurnDepth",
        "RandomVoxelSample",
        "RemoveDuplicates",
        "RemoveFlyingPixels",
        "RemoveHiddenPoints",
        "RemovePlane",
        "RemoveRadiusOutliers",
        "RemoveStatisticalOutliers",
        "ResizeDepth",
        "ShiftToOrigin",
        "SpatialFilterDepth",
        "SplitObjects",
        "ToFrame",
        "Transform",
        "TurnDepth",
        "Undistort",
        "mix_scenes",
        "VoxelDownsample",
        "VoxelSample",
    ],
    "pcdata.io": [
        "AveragedSource",
        "CaptureSource",
        "JoinedSource",
        "SubsetSource",
        "TemporalFilterDepth",
        "TemporallyFilteredSource",
        "from_open3d",
        "from_pyg",
        "open_source",
        "read_calibration",
        "read_pcd",
        "read_ply",
        "read_volume",
        "refused_captures",
        "register_combinator",
        "register_layout",
        "to_open3d",
        "to_pyg",
        "with_droid_extrinsics",
        "write_calibration",
        "write_capture",
        "write_episodes",
        "write_pcd",
        "write_ply",
        "write_volume",
    ],
    "pcdata.imports": ["import_file"],
    "pcdata.datasets": [
        "CachedCloudDataset",
        "CloudDataset",
        "CountedSampler",
        "DevicePipeline",
        "MixedCloudDataset",
        "EpisodeWindows",
        "StreamedCloudDataset",
        "collate_fixed",
        "collate_packed",
        "collate_padded",
        "collate_windows",
        "fit_normalizers",
        "register_collate",
        "set_epoch",
        "split_dataset",
        "COLLATES",
    ],
    "pcdata.models": ["ModelBatch", "ModelContract", "check", "preset", "to_frame", "to_source"],
    "pcdata.build": ["build_dataset", "load_config"],
    "pcdata.exports": ["export_dataset", "write_clouds"],
    "pcdata.validation": ["validate_frame", "validate_source"],
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}
_SUBMODULES = [
    "alignment",
    "build",
    "calibration",
    "datasets",
    "errors",
    "exports",
    "functional",
    "geometry",
    "io",
    "live",
    "models",
    "report",
    "sensors",
    "structures",
    "synthetic",
    "transforms",
    "validation",
]

__all__ = ["__version__", *_HOME_OF, *_SUBMODULES]


def __getattr__(name: str) -> Any:
    if name in _HOME_OF:
        found = globals()[name] = getattr(importlib.import_module(_HOME_OF[name]), name)  # asked for once
        return found
    if name in _SUBMODULES:
        return importlib.import_module(f"pcdata.{name}")
    raise AttributeError(f"module 'pcdata' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
