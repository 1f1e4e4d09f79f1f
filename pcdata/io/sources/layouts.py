"""The layouts and combinators that come with pcdata, in the order that help texts and messages list them."""

# isort: off
from pcdata.io.sources import (  # noqa: F401
    folder,
    rig,
    graspnet,
    seven_scenes,
    scannet,
    tum,
    sun3d,
    nyu_raw,
    open3d_rgbd,
    apc,
    bop,
    rlbench,
    robomimic,
    maniskill,
    pairs,
    realsense_bag,
    ros,
    azure_kinect,
    lerobot,
    cloud_files,
    averaged,
    temporal,
    convention,
    posed,
)

# isort: on
from pcdata.io.sources.registry import COMBINATORS, LAYOUTS

__all__ = ["COMBINATORS", "LAYOUTS"]
