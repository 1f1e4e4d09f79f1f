"""The nouns: cameras, depth frames, point clouds."""

from pcdata.structures.camera import Camera
from pcdata.structures.confidence import Confidence
from pcdata.structures.depth_frame import CAMERA_FRAME, DepthFrame
from pcdata.structures.fields import Kind
from pcdata.structures.padded import PaddedClouds
from pcdata.structures.point_cloud import METRE, NORMALIZED, ImageLayout, PointCloud

__all__ = [
    "CAMERA_FRAME",
    "METRE",
    "NORMALIZED",
    "Camera",
    "Confidence",
    "DepthFrame",
    "ImageLayout",
    "Kind",
    "PaddedClouds",
    "PointCloud",
]
