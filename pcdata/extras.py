"""Optional dependencies: what is installed, and the exact command that installs what is not."""

from __future__ import annotations

import importlib
import importlib.util
from dataclasses import dataclass
from types import ModuleType

from pcdata.errors import MissingExtraError

# Open3D's wheel is linked against these and does not bring them along.
_OPEN3D_LIBRARIES = "apt-get install libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1 libidn2-0 libudev1"


@dataclass(frozen=True)
class _Extra:
    """One optional dependency."""

    module: str
    name: str  # of the extra in pcdata's metadata
    purpose: str
    own_install: str = ""  # what installs it where the extra cannot

    @property
    def install(self) -> str:
        """The command that installs it."""
        return self.own_install or f'pip install "pcdata[{self.name}]"'


EXTRAS = {
    extra.module: extra
    for extra in (
        _Extra("matplotlib", "viz", "pictures (pcdata demo, pcdata.report)"),
        _Extra("cv2", "calib", "calibration boards and InpaintDepth"),
        _Extra("small_gicp", "calib", "refining camera poses, and aligning clouds by GICP"),
        _Extra("numcodecs", "zarr", "zarr chunks packed with Blosc, Zstandard or LZ4"),
        _Extra("OpenEXR", "exr", "depth in OpenEXR files (.exr)"),
        _Extra("av", "av", "recordings of an Azure Kinect (.mkv) and videos of LeRobot datasets"),
        _Extra("pyarrow", "lerobot", "LeRobot datasets"),
        _Extra("fsspec", "remote", "datasets at a URL"),
        _Extra("s3fs", "remote", "datasets at s3://"),
        _Extra("ray", "ray", "builds on a cluster (pcdata build --engine ray)"),
        _Extra("rerun", "rerun", "logs for Rerun's viewer (pcdata view --rerun)"),
        _Extra("rosbags", "ros", "recordings of robots (.bag, .mcap, .db3)"),
        _Extra("cuda.core", "cuda", "kernels on a GPU (the cuda backend)"),
        _Extra("open3d", "open3d", "global alignment, and handing clouds, meshes and cameras to Open3D and back"),
        _Extra("torch_geometric", "pyg", "handing clouds to PyTorch Geometric and back"),
        _Extra(
            "torch_cluster",
            "cluster",
            "the torch_cluster backend",
            "pip install ninja && pip install --no-build-isolation torch-cluster",
        ),
    )
}


def require(module: str) -> ModuleType:
    """Import an optional dependency.

    Raises:
        MissingExtraError: with what it is for and the command that installs it.
    """
    problem = why_missing(module)
    if problem is not None:
        raise MissingExtraError(problem)
    return importlib.import_module(module)


def why_missing(module: str) -> str | None:
    """Return None when the dependency can be imported, else what is wrong and what to run."""
    extra = EXTRAS[module]
    if not _is_found(module):
        return f"{module} is not installed; it is needed for {extra.purpose}: run {extra.install}"
    try:
        importlib.import_module(module)
    except Exception as error:  # a wheel built for another torch or numpy fails in ways of its own
        repair = f"reinstall it: {extra.install}"
        if module == "open3d":
            repair = f"on Debian or Ubuntu run {_OPEN3D_LIBRARIES}"
        return f"{module} is installed but cannot be loaded ({type(error).__name__}: {error}); {repair}"
    return None


def _is_found(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # nor is the package that it is a part of
        return False
