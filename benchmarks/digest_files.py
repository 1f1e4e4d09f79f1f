"""Digests of what is read from every capture layout, of every file that is written, and of every store."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import digest_names as its
from digest_hash import Many
from digest_inputs import (
    Samples,
    base_cloud,
    camera_cloud,
    pose,
    rendered,
    scratch,
    small_frame,
    with_confidence,
)
from digest_real import COPIED, real_folder, real_frame, source_of

Case = tuple[str, Callable[[], Any]]


def loaded(source: Any, count: int = 2) -> Many:
    """The ids of a source, and its first captures."""
    return Many({"ids": list(source.ids), **{name: source.load(name) for name in source.ids[:count]}})


# -- readers -----------------------------------------------------------------------------------------------------------


def _real_readers(root: Path) -> Iterator[Case]:
    for name in ("graspnet_frame", "seven_scenes", "osd", "pcd", *COPIED):
        yield f"read/{name}", lambda name=name: loaded(source_of(name))
    try:
        import rosbags  # noqa: F401
    except ImportError:
        print("digests: rosbags is missing, so no recording is read", file=sys.stderr)
    else:
        bag = root / "realsense_bag" / "single_depth_color_640x480.bag"
        yield "read/realsense_bag", lambda: loaded(its.open_source(bag))
    averaged = {"num_frames": 2, "min_count": 1, "max_moving": 1.0}
    yield "read/tabletop_stream averaged", lambda: loaded(its.AveragedSource(source=_stream(2), **averaged))
    yield "read/tabletop_stream filtered", lambda: loaded(_filtered(_stream(3)), 3)
    yield "read/seven_scenes subset", lambda: loaded(_first(50).subset(["frame-000200", "frame-000040"]))
    yield "read/seven_scenes without", lambda: loaded(_first(4).without(["frame-000020"]))
    for file in ("osd/learn0.pcd", "pcd/milk_cartoon_all_small_clorox.pcd", "pcd/table_scene_mug_stereo_textured.pcd"):
        yield f"read/{file}", lambda file=file: its.read_pcd(root / file)


def _filtered(source: Any) -> Any:
    return its.TemporallyFilteredSource(source=source)


def _first(count: int) -> Any:
    source = source_of("seven_scenes")
    return source.subset(source.ids[:count])


def _stream(count: int) -> Any:
    source = source_of("tabletop_stream")
    return source.subset(source.ids[:count])


def _rig(views: int = 2, *, with_poses: bool = True) -> Path:
    """Write a capture of several cameras as one folder per camera."""
    frame = with_confidence(rendered(views, 5))
    root = scratch("rig")
    for view in range(views):
        folder = root / f"camera{view}"
        for role in ("depth", "color", "labels", "confidence", *(("poses",) if with_poses else ())):
            (folder / role).mkdir(parents=True)
        its.write_depth(folder / "depth" / "f0.png", frame.depth[view], metres_per_unit=0.001, round_to_unit=True)
        its.write_color(folder / "color" / "f0.png", frame.colors[view])
        its.write_labels(folder / "labels" / "f0.png", frame.labels[view], background_label=255)
        its.write_confidence(folder / "confidence" / "f0.png", frame.confidence[view])
        if with_poses:
            its.write_pose(folder / "poses" / "f0.txt", frame.world_from_camera[view])
        its.write_capture_camera(
            folder / "intrinsics.json",
            its.CaptureCamera(
                camera=frame.camera.view(view),
                metres_per_unit=0.001,
                frame_id=frame.frame_id if with_poses else None,
                background_label=255,
            ),
        )
    return root


def _calibrated_rig() -> Any:
    """The rig with its poses from a calibration file."""
    frame, root = rendered(2, 5), _rig(with_poses=False)
    file = scratch("rig calibration") / "rig.yaml"
    calibration = its.Calibration(
        cameras={f"camera{view}": frame.camera.view(view) for view in range(2)},
        transforms={f"base_from_camera{view}": frame.world_from_camera[view].clone() for view in range(2)},
    )
    its.write_calibration(file, calibration)
    return loaded(its.open_source(root, kind="rig", calibration=str(file), frame_id="base"))


# -- single files ------------------------------------------------------------------------------------------------------


def _file(name: str, write: Callable[[Path], Any], read: Callable[[Path], Any] | None = None) -> Many:
    """The bytes of a file, and what is read back from it."""
    path = scratch("files") / name
    write(path)
    return Many({"bytes": path.read_bytes(), **({} if read is None else {"read": read(path)})})


def _writers() -> Iterator[Case]:
    cloud = replace(base_cloud((120,)), extra={}, kinds={})
    plain = replace(cloud, normals=None, labels=None, colors=None, source_index=None)
    for name, one in {
        "full": cloud,
        "points": plain,
        "extra": base_cloud((120,)),
        "camera": camera_cloud((9,)),
    }.items():
        for encoding in ("binary", "ascii"):
            yield (
                f"write/ply {encoding}/{name}",
                lambda one=one, encoding=encoding: _file(
                    "a.ply", lambda path: its.write_ply(path, one, encoding=encoding), its.read_ply
                ),
            )
        for encoding in ("binary", "ascii", "binary_compressed"):
            yield (
                f"write/pcd {encoding}/{name}",
                lambda one=one, encoding=encoding: _file(
                    "a.pcd", lambda path: its.write_pcd(path, one, encoding=encoding), its.read_pcd
                ),
            )
    yield "write/ply mesh", lambda: _file("a.ply", lambda path: its.write_ply(path, _mesh()), its.read_ply)
    frame = small_frame((150,))
    depth, unit = frame.depth[0], {"metres_per_unit": 0.001}
    yield (
        "write/depth",
        lambda: _file(
            "d.png",
            lambda path: its.write_depth(path, depth, round_to_unit=True, **unit),
            lambda path: its.read_depth(path, **unit),
        ),
    )
    yield "write/color", lambda: _file("c.png", lambda path: its.write_color(path, frame.colors[0]), its.read_color)
    labels = frame.labels[0]
    yield (
        "write/labels",
        lambda: _file("l.png", lambda path: its.write_labels(path, labels, background_label=9), its.read_labels),
    )
    yield "write/mask", lambda: _file("m.png", lambda path: its.write_mask(path, frame.mask[0]), its.read_mask)
    levels = frame.confidence[0]
    yield (
        "write/confidence",
        lambda: _file("c.png", lambda path: its.write_confidence(path, levels), its.read_confidence),
    )
    yield "write/pose", lambda: _file("p.txt", _write_pose, its.read_pose)
    lens = its.Camera.pinhole(
        fx=604.0, fy=606.5, cx=316.2, cy=244.7, size=(480, 640), distortion=[0.08, -0.15, 0.001, 0, 0]
    )
    stated = its.CaptureCamera(camera=lens, metres_per_unit=0.00025, frame_id="base", background_label=7)
    yield "write/intrinsics.json", lambda: _file("i.json", lambda path: its.write_capture_camera(path, stated))
    evidence = its.Evidence(method="board", num_observations=20, residuals={"rms_px": 0.2125}, date="2026-01-31")
    calibration = its.Calibration(
        cameras={"wrist": lens, "top": rendered().camera.view(0)},
        transforms={"gripper_from_wrist": pose(3), "base_from_top": pose(4)},
        evidence={"wrist": evidence, "base_from_top": evidence},
    )
    yield (
        "write/calibration.yaml",
        lambda: _file("c.yaml", lambda path: its.write_calibration(path, calibration), _read_calibration),
    )
    for name, one in {"made up": small_frame(), "rendered": with_confidence(rendered(2, 5))}.items():
        yield f"write/capture/{name}", lambda one=one: _captured(one)


def _write_pose(path: Path) -> None:
    its.write_pose(path, pose(3))


def _write_calibration(calibration: Any, path: Path) -> None:
    its.write_calibration(path, calibration)


def _read_calibration(path: Path) -> Any:
    found = its.read_calibration(path)
    return [found.cameras, found.transforms, found.evidence]


def _mesh() -> Any:
    volume = its.TSDFVolume(voxel_size=0.03)
    volume.integrate(rendered(2, 5))
    return volume.extract_mesh()


def _captured(frame: Any) -> Many:
    """The files that keep a raw capture beside its cloud, and the captures read from them."""
    folder = scratch("capture") / "raw"
    its.write_capture(frame, folder)
    views = sorted(view.name for view in folder.iterdir())
    return Many({"files": files_of(folder), **{view: loaded(its.open_source(folder / view)) for view in views}})


def files_of(folder: Path, *, leave_out: tuple[str, ...] = ()) -> dict[str, bytes]:
    """Every file below a folder by its path, but for names left out."""
    found = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
    return {name: path.read_bytes() for name, path in found.items() if path.name not in leave_out}


# -- stores ------------------------------------------------------------------------------------------------------------

STORED = {
    "hdf5": ("none", "lzf", "gzip"),
    "npz": ("none", "gzip"),
    "packed": ("none",),
    "pt": ("none",),
    "webdataset": ("none",),
}
CONFIG = """\
depth: [MaskDepth: {near: 0.2, far: 3.0}, Deproject]
cloud:
  - ToFrame: {frame: base}
  - VoxelDownsample: {voxel_size: 0.02}
  - EstimateNormals: {radius: 0.06}
augment: [RandomRotation: {degrees: 90}, RandomPointDropout: {low: 0.1, high: 0.3}]
"""


def captures() -> Samples:
    """Three captures: two of one view, one of two."""
    return Samples({"s10": rendered(1, 1), "s9": rendered(1, 2), "two views": rendered(2, 3)})


def dataset(kind: str = "hdf5", compression: str = "none") -> Path:
    """Build a small dataset."""
    folder = scratch(f"datasets/{kind} {compression}") / "dataset"
    its.build(f"{CONFIG}output: {{format: {kind}, compression: {compression}, keep_raw: true}}\n", captures(), folder)
    return folder


def _stored(kind: str, compression: str) -> Many:
    from digest_names import pcdata

    folder = dataset(kind, compression)
    read = pcdata.CachedCloudDataset(folder, augment=None)
    samples = list(zip(read.ids, read, strict=True))
    raw = files_of(folder / "shards/00000/raw")
    bytes_of = files_of(folder, leave_out=("dataset.json", "pipeline.yaml", "load.py"))
    written = {name: content for name, content in bytes_of.items() if "/raw/" not in name}
    return Many({"ids": list(read.ids), "clouds": [cloud for _, cloud in samples], "raw": raw, "files": written})


def _stores() -> Iterator[Case]:
    for kind, ways in STORED.items():
        for way in ways:
            yield f"store/{kind} {way}", lambda kind=kind, way=way: _stored(kind, way)


def cases() -> Iterator[Case]:
    """Yield ``read/layout``, ``write/file`` and ``store/format compression``."""
    yield "read/rig", lambda: loaded(its.open_source(_rig()))
    yield "read/rig with a calibration", _calibrated_rig
    root = real_folder()
    if root is not None:
        yield from _real_readers(root)
        smaller = its.step("DecimateDepth", factor=4)
        yield "write/capture/seven_scenes", lambda: _captured(its.run(smaller, real_frame("seven_scenes")))
    yield from _writers()
    yield from _stores()
