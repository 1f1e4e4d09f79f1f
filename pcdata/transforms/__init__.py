"""Transforms: configured steps from captures to clouds, composed into pipelines."""

from pcdata.transforms.base import REGISTRY, Transform
from pcdata.transforms.chain_rules import PipelineOrderWarning
from pcdata.transforms.clusters import ClusterObjects
from pcdata.transforms.completion import CompleteDepth
from pcdata.transforms.compose import Compose
from pcdata.transforms.crop import CropPolygon, CropWorkspace
from pcdata.transforms.deproject import Deproject, MaskDepth
from pcdata.transforms.depth_filters import FillHoles, RemoveFlyingPixels, SpatialFilterDepth
from pcdata.transforms.depth_inpainting import InpaintDepth
from pcdata.transforms.depth_sizes import CropCenter, DecimateDepth, RandomTurnDepth, ResizeDepth, TurnDepth
from pcdata.transforms.downsample import VoxelDownsample
from pcdata.transforms.families import LeftOutWarning, RemoveTransform, SelectTransform, SpatialTransform
from pcdata.transforms.farthest_samples import FarthestPointSample, RandomFarthestPointSample
from pcdata.transforms.found_planes import plane_hulls_in_cloud, planes_in_cloud
from pcdata.transforms.frames import MergeViews, ToFrame
from pcdata.transforms.fusion import FuseTSDF
from pcdata.transforms.grasps import judge_grasps
from pcdata.transforms.keep_confidence import KeepConfidence
from pcdata.transforms.labels import MapLabels
from pcdata.transforms.mixing import mix_scenes
from pcdata.transforms.normalize import Center, NormalizeUnitSphere, NormalizeWorkspace, ShiftToOrigin
from pcdata.transforms.normals import EstimateNormals
from pcdata.transforms.object_facts import ObjectFacts, describe_objects, label_image
from pcdata.transforms.outliers import RemoveRadiusOutliers, RemoveStatisticalOutliers
from pcdata.transforms.plane_alarms import TiltedPlaneWarning, UnmeasuredTableWarning
from pcdata.transforms.planes import RemovePlane
from pcdata.transforms.random_apply import RandomApply, RandomOneOf
from pcdata.transforms.random_column import RandomColumn
from pcdata.transforms.random_elastic import RandomElastic
from pcdata.transforms.random_jitter import RandomColorDrop, RandomColorJitter, RandomJitter, RandomPointDropout
from pcdata.transforms.random_motions import (
    RandomFlip,
    RandomRotation,
    RandomScale,
    RandomShear,
    RandomTranslation,
)
from pcdata.transforms.random_parts import RandomCuboid, RandomOcclusion
from pcdata.transforms.random_samples import RandomPointCount, RandomSample, RandomShuffle
from pcdata.transforms.selection import DropNonFinite, KeepValues, RemoveDuplicates
from pcdata.transforms.sensor_noise import RandomSensorNoise
from pcdata.transforms.shape import DescribeShape
from pcdata.transforms.simple_completions import NearestCompletion, SmoothCompletion
from pcdata.transforms.split_objects import SplitObjects
from pcdata.transforms.undistort import Undistort
from pcdata.transforms.unreliable import MarkUnreliableDepth
from pcdata.transforms.visibility import CropFrustum, RemoveHiddenPoints
from pcdata.transforms.voxel_sample import RandomVoxelSample, VoxelSample
from pcdata.transforms.window_filters import BilateralFilterDepth, MedianFilterDepth

__all__ = [
    "REGISTRY",
    "BilateralFilterDepth",
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
    "InpaintDepth",
    "KeepConfidence",
    "KeepValues",
    "LeftOutWarning",
    "MapLabels",
    "MarkUnreliableDepth",
    "MaskDepth",
    "MedianFilterDepth",
    "MergeViews",
    "NearestCompletion",
    "NormalizeUnitSphere",
    "NormalizeWorkspace",
    "ObjectFacts",
    "PipelineOrderWarning",
    "RandomApply",
    "RandomColorDrop",
    "RandomColorJitter",
    "RandomColumn",
    "RandomCuboid",
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
    "RemoveTransform",
    "ResizeDepth",
    "SelectTransform",
    "ShiftToOrigin",
    "SmoothCompletion",
    "SpatialFilterDepth",
    "SpatialTransform",
    "SplitObjects",
    "TiltedPlaneWarning",
    "ToFrame",
    "Transform",
    "TurnDepth",
    "Undistort",
    "UnmeasuredTableWarning",
    "VoxelDownsample",
    "VoxelSample",
    "describe_objects",
    "judge_grasps",
    "label_image",
    "mix_scenes",
    "plane_hulls_in_cloud",
    "planes_in_cloud",
]
