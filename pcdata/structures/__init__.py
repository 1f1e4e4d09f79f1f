"""The nouns: cameras, depth frames, point clouds."""

from pcdata.functional.depth.confidence import Confidence
from pcdata.structures.calibration import Calibration, Evidence
from pcdata.structures.camera import Camera
from pcdata.structures.depth_frame import DepthFrame
from pcdata.structures.depth_to_color import register_to_color
from pcdata.structures.episodes import Episode
from pcdata.structures.filled_depth import confidence_of, with_filled_depth
from pcdata.structures.image_layout import ImageLayout
from pcdata.structures.kinds import CAMERA_FRAME, METRE, NORMALIZED, Kind
from pcdata.structures.padded import PaddedClouds
from pcdata.structures.point_cloud import PointCloud
from pcdata.structures.rendering import Rendered, render
from pcdata.structures.signals import Signal
from pcdata.structures.surface_mesh import SurfaceMesh
from pcdata.structures.tsdf_volume import TSDFVolume

__all__ = [
    "CAMERA_FRAME",
    "METRE",
    "NORMALIZED",
    "Calibration",
    "Camera",
    "Confidence",
    "DepthFrame",
    "Episode",
    "Evidence",
    "ImageLayout",
    "Kind",
    "PaddedClouds",
    "PointCloud",
    "Rendered",
    "Signal",
    "SurfaceMesh",
    "TSDFVolume",
    "confidence_of",
    "register_to_color",
    "render",
    "with_filled_depth",
]
