"""Bytes <-> structures: depth images, calibration, cloud files, and one source per capture layout."""

from pcdata.io.arrays.signal_files import read_signals, write_signals
from pcdata.io.calibration.calibration_yaml import read_calibration, write_calibration
from pcdata.io.calibration.capture_camera import (
    CaptureCamera,
    read_capture_camera,
    read_intrinsics,
    read_pose,
    write_capture_camera,
    write_pose,
)
from pcdata.io.calibration.droid import with_droid_extrinsics
from pcdata.io.clouds.pcd import read_pcd, write_pcd
from pcdata.io.clouds.ply import read_ply, write_ply
from pcdata.io.images.confidence import read_confidence, write_confidence
from pcdata.io.images.reading import read_color, read_depth, read_labels, read_mask
from pcdata.io.images.writing import write_color, write_depth, write_labels, write_mask
from pcdata.io.libraries.open3d import from_open3d, to_open3d
from pcdata.io.libraries.open3d_cameras import Open3DView, PosedCamera
from pcdata.io.libraries.pyg import from_pyg, to_pyg
from pcdata.io.sources.averaged import AveragedSource
from pcdata.io.sources.capture_source import CaptureSource, refused_captures
from pcdata.io.sources.combine import CombinedSource, SubsetSource
from pcdata.io.sources.episode_file import write_episodes
from pcdata.io.sources.joined_source import JoinedSource
from pcdata.io.sources.open_source import open_source
from pcdata.io.sources.registry import COMBINATORS, LAYOUTS, register_combinator, register_layout
from pcdata.io.sources.source import Source
from pcdata.io.sources.temporal import TemporalFilterDepth, TemporallyFilteredSource
from pcdata.io.store.stores import STORES, Store, register_store
from pcdata.io.store.volumes import read_volume, write_volume
from pcdata.io.writers.capture_folder import write_capture
from pcdata.io.writers.conversion import convert
from pcdata.io.writers.registry import WRITERS, register_writer
from pcdata.io.writers.writer import Captures, Writer, WrittenReport

__all__ = [
    "COMBINATORS",
    "LAYOUTS",
    "STORES",
    "WRITERS",
    "AveragedSource",
    "CaptureCamera",
    "CaptureSource",
    "Captures",
    "CombinedSource",
    "JoinedSource",
    "Open3DView",
    "PosedCamera",
    "Source",
    "Store",
    "SubsetSource",
    "TemporalFilterDepth",
    "TemporallyFilteredSource",
    "Writer",
    "WrittenReport",
    "convert",
    "from_open3d",
    "from_pyg",
    "open_source",
    "read_calibration",
    "read_capture_camera",
    "read_color",
    "read_confidence",
    "read_depth",
    "read_intrinsics",
    "read_labels",
    "read_mask",
    "read_pcd",
    "read_ply",
    "read_pose",
    "read_signals",
    "read_volume",
    "refused_captures",
    "register_combinator",
    "register_layout",
    "register_store",
    "register_writer",
    "to_open3d",
    "to_pyg",
    "with_droid_extrinsics",
    "write_calibration",
    "write_capture",
    "write_capture_camera",
    "write_color",
    "write_confidence",
    "write_depth",
    "write_episodes",
    "write_labels",
    "write_mask",
    "write_pcd",
    "write_ply",
    "write_pose",
    "write_signals",
    "write_volume",
]
