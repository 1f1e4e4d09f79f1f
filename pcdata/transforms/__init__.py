"""Transforms: configured steps from captures to clouds, composed into pipelines."""

from pcdata.transforms.augment import RandomFlip, RandomRotation, RandomScale, RandomTranslation
from pcdata.transforms.base import REGISTRY, SelectTransform, SpatialTransform, Transform
from pcdata.transforms.chain_rules import PipelineOrderWarning
from pcdata.transforms.clusters import ClusterObjects, LeftOutWarning, SplitObjects
from pcdata.transforms.columns import RandomColumn, ShiftToOrigin
from pcdata.transforms.completion import CompleteDepth
from pcdata.transforms.compose import Compose
from pcdata.transforms.confidence import KeepConfidence
from pcdata.transforms.crop import CropWorkspace
from pcdata.transforms.depth import Deproject, MaskDepth
from pcdata.transforms.depth_filters import FillHoles, RemoveFlyingPixels, SpatialFilterDepth
from pcdata.transforms.depth_inpainting import InpaintDepth
from pcdata.transforms.depth_sizes import CropCenter, DecimateDepth, ResizeDepth
from pcdata.transforms.downsample import FarthestPointSample, RandomPointCount, RandomSample, VoxelDownsample
from pcdata.transforms.frames import MergeViews, ToFrame
from pcdata.transforms.fusion import FuseTSDF
from pcdata.transforms.inpainting import NearestCompletion, SmoothCompletion
from pcdata.transforms.noise import RandomColorJitter, RandomJitter, RandomPointDropout
from pcdata.transforms.normalize import Center, NormalizeUnitSphere, NormalizeWorkspace
from pcdata.transforms.normals import EstimateNormals
from pcdata.transforms.outliers import RemoveRadiusOutliers, RemoveStatisticalOutliers
from pcdata.transforms.planes import RemovePlane, planes_in_cloud
from pcdata.transforms.random_apply import RandomApply
from pcdata.transforms.sensor_noise import RandomSensorNoise
from pcdata.transforms.unreliable import MarkUnreliableDepth
from pcdata.transforms.voxel_sample import RandomVoxelSample, VoxelSample

__all__ = [
    "REGISTRY",
    "Center",
    "ClusterObjects",
    "CompleteDepth",
    "Compose",
    "CropCenter",
    "CropWorkspace",
    "DecimateDepth",
    "Deproject",
    "EstimateNormals",
    "FarthestPointSample",
    "FillHoles",
    "FuseTSDF",
    "InpaintDepth",
    "KeepConfidence",
    "LeftOutWarning",
    "MarkUnreliableDepth",
    "MaskDepth",
    "MergeViews",
    "NearestCompletion",
    "NormalizeUnitSphere",
    "NormalizeWorkspace",
    "PipelineOrderWarning",
    "RandomApply",
    "RandomColorJitter",
    "RandomColumn",
    "RandomFlip",
    "RandomJitter",
    "RandomPointCount",
    "RandomPointDropout",
    "RandomRotation",
    "RandomSample",
    "RandomScale",
    "RandomSensorNoise",
    "RandomTranslation",
    "RandomVoxelSample",
    "RemoveFlyingPixels",
    "RemovePlane",
    "RemoveRadiusOutliers",
    "RemoveStatisticalOutliers",
    "ResizeDepth",
    "SelectTransform",
    "ShiftToOrigin",
    "SmoothCompletion",
    "SpatialFilterDepth",
    "SpatialTransform",
    "SplitObjects",
    "ToFrame",
    "Transform",
    "VoxelDownsample",
    "VoxelSample",
    "planes_in_cloud",
]
