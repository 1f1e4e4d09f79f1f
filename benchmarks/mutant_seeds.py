"""Small valid files of every format, written by pcdata and by others: what ``mutants.py`` damages."""

from __future__ import annotations

import importlib.util
import json
import shutil
import struct
import zlib
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image


def write_seeds(folder: Path) -> None:
    """Write the seeds of every reader, as READER/NAME/files; none for those whose extra is not installed."""
    number = np.random.default_rng(0)
    depth = number.integers(500, 1500, (24, 32)).astype(np.uint16)
    color = number.integers(0, 256, (24, 32, 3)).astype(np.uint8)
    labels = number.integers(0, 4, (24, 32)).astype(np.uint8)
    _write_images(folder, depth, color, labels)
    for reader in ("intrinsics_json", "pose_npy", "pose_txt", "timestamps_json"):
        _write_capture(_new(folder, reader), depth, color, labels, pose="npy" if reader == "pose_npy" else "txt")
    _write_meta(folder, depth, color)
    _write_datasets(folder)
    _write_foreign(folder, number.random((8, 16, 3)).astype(np.float32))
    _write_clouds(folder)
    _write_texts(folder)
    _write_volume(_new(folder, "tsdf_npz") / "v.npz")
    _write_demonstrations(folder, depth[:6, :8], color[:6, :8])
    with suppress(ImportError):
        _write_bags(folder, depth[:9, :12], color[:9, :12])


def _new(folder: Path, reader: str, name: str = "own") -> Path:
    made = folder / reader / name
    made.mkdir(parents=True)
    return made


def _write_images(folder: Path, depth: np.ndarray, color: np.ndarray, labels: np.ndarray) -> None:
    Image.fromarray(depth).save(_new(folder, "depth_png") / "d.png")
    Image.fromarray(depth).save(_new(folder, "depth_tiff") / "d.tiff")
    Image.fromarray(depth).save(_new(folder, "depth_tiff", "deflate") / "d.tiff", compression="tiff_adobe_deflate")
    Image.fromarray(depth).save(_new(folder, "depth_tiff", "lzw") / "d.tiff", compression="tiff_lzw")
    np.save(_new(folder, "depth_npy") / "d.npy", depth)
    np.save(_new(folder, "depth_npy", "float") / "d.npy", (depth / 1000).astype(np.float32))
    Image.fromarray(color).save(_new(folder, "color_png") / "c.png")
    Image.fromarray(color).save(_new(folder, "color_jpg") / "c.jpg")
    Image.fromarray(color).save(_new(folder, "color_jpg", "progressive") / "c.jpg", progressive=True)
    Image.fromarray(labels).save(_new(folder, "label_png") / "l.png")
    Image.fromarray(labels).save(_new(folder, "confidence_png") / "c.png")
    Image.fromarray((labels > 1).astype(np.uint8) * 255).save(_new(folder, "mask_png") / "m.png")
    Image.fromarray(labels > 1).save(_new(folder, "mask_png", "bits") / "m.png")


def _write_capture(folder: Path, depth: np.ndarray, color: np.ndarray, labels: np.ndarray, *, pose: str) -> None:
    capture = folder / "cap"
    for kind, image in {"depth": depth, "color": color, "labels": labels, "confidence": labels}.items():
        (capture / kind).mkdir(parents=True)
        Image.fromarray(image).save(capture / kind / "0001.png")
    (capture / "poses").mkdir()
    matrix = np.array([[1.0, 0, 0, 0.1], [0, 0, -1, 0.2], [0, 1, 0, 0.3], [0, 0, 0, 1]])
    if pose == "npy":
        np.save(capture / "poses" / "0001.npy", matrix)
    else:
        np.savetxt(capture / "poses" / "0001.txt", matrix)
    camera = {"width": 32, "height": 24, "fx": 30.5, "fy": 30.25, "cx": 15.5, "cy": 11.5, "metres_per_unit": 0.001}
    camera |= {"distortion": [0.01, -0.02, 0.001, 0.002, 0.005], "frame_id": "base", "background_label": 0}
    (capture / "intrinsics.json").write_text(json.dumps(camera))
    (capture / "timestamps.json").write_text(json.dumps({"0001": 12.033}))


def _write_meta(folder: Path, depth: np.ndarray, color: np.ndarray) -> None:
    from scipy.io import savemat

    facts = {
        "intrinsic_matrix": np.array([[30.5, 0, 15.5], [0, 30.5, 11.5], [0, 0, 1]]),
        "factor_depth": np.array([[1000]], np.uint16),
        "cls_indexes": np.array([[1, 3]], np.uint8),
        "poses": np.stack([np.eye(4)[:3], np.eye(4)[:3]], axis=2),
    }
    for name, options in {"plain": {}, "packed": {"do_compression": True}, "level4": {"format": "4"}}.items():
        made = _new(folder, "meta_mat", name)
        Image.fromarray(depth).save(made / "depth.png")
        Image.fromarray(color).save(made / "color.png")
        kept = {key: value for key, value in facts.items() if value.ndim == 2 or name != "level4"}
        savemat(made / "meta.mat", kept, **options)


class _TwoCaptures:
    """A source of two small captures."""

    ids = ("a", "b")

    def load(self, sample_id: str) -> Any:
        from pcdata import Camera, DepthFrame

        generator = torch.Generator().manual_seed(ord(sample_id))
        depth = 0.5 + 0.1 * torch.rand(1, 9, 12, generator=generator)
        colors = torch.randint(0, 256, (1, 9, 12, 3), generator=generator, dtype=torch.uint8)
        camera = Camera.pinhole(fx=20.0, fy=20.0, cx=5.5, cy=4.0, size=(9, 12))
        return DepthFrame(depth=depth, camera=camera, colors=colors, sample_id=sample_id)


def _write_datasets(folder: Path) -> None:
    from pcdata.build import build_dataset
    from pcdata.build.config import config_from_yaml

    kinds = {"npz": ("none", "gzip"), "hdf5": ("none", "gzip", "lzf"), "pt": ("none",)}
    for kind, ways in kinds.items():
        for packing in ways:
            made = _new(folder, {"npz": "npz_dataset", "hdf5": "h5_dataset", "pt": "pt_dataset"}[kind], packing)
            text = f"depth: [Deproject]\noutput: {{format: {kind}, compression: {packing}}}\n"
            build_dataset(config_from_yaml(text), _TwoCaptures(), made / "ds")
    for kind in ("packed", "webdataset"):  # read by the dataset, which hashes them, and by the store alone
        for compact in (False, True):
            made = _new(folder, f"{kind}_dataset", "compact" if compact else "plain")
            text = f"depth: [Deproject]\noutput: {{format: {kind}, compact: {str(compact).lower()}}}\n"
            build_dataset(config_from_yaml(text), _TwoCaptures(), made / "ds")
    for kind in ("npz", "h5", "pt", "packed", "webdataset"):
        shutil.copytree(folder / f"{kind}_dataset", folder / f"{kind}_store")
    if importlib.util.find_spec("fsspec") is not None:
        for kind in ("stream", "url"):
            shutil.copytree(folder / "webdataset_dataset", folder / f"webdataset_{kind}")
    for reader in ("manifest", "dataset_index", "shard_table"):
        shutil.copytree(folder / "npz_dataset" / "none", folder / reader / "npz")


def _write_foreign(folder: Path, clouds: np.ndarray) -> None:
    import h5py

    np.save(_new(folder, "npy_foreign") / "a.npy", clouds)
    np.savez(_new(folder, "npz_foreign") / "a.npz", pc=clouds)
    np.savez_compressed(_new(folder, "npz_foreign", "deflate") / "a.npz", pc=clouds)
    for name in ("none", "gzip", "lzf"):
        with h5py.File(_new(folder, "h5_foreign", name) / "a.h5", "w") as file:
            file.create_dataset("pc", data=clouds, compression=None if name == "none" else name)
    codecs: dict[str, Any] = {"none": (None, bytes), "zlib": ({"id": "zlib", "level": 1}, zlib.compress)}
    with suppress(ImportError):
        import numcodecs

        for codec in (numcodecs.Blosc("lz4"), numcodecs.Zstd(1), numcodecs.LZ4()):
            codecs[codec.codec_id] = codec.get_config(), codec.encode
    for name, (compressor, pack) in codecs.items():
        array = _new(folder, "zarr_foreign", name) / "a.zarr" / "data" / "pc"
        array.mkdir(parents=True)
        head = {"zarr_format": 2, "shape": [8, 16, 3], "chunks": [4, 16, 3], "dtype": "<f4", "compressor": compressor}
        (array / ".zarray").write_text(json.dumps({**head, "filters": None, "order": "C", "fill_value": 0.0}))
        for chunk in range(2):
            (array / f"{chunk}.0.0").write_bytes(pack(clouds[4 * chunk : 4 * chunk + 4].tobytes()))


def _write_demonstrations(folder: Path, depth: np.ndarray, color: np.ndarray) -> None:
    """Write two steps as robomimic and as ManiSkill store them, and metadata as a pickle of arrays."""
    import pickle

    import h5py

    matrix, pose = np.array([[10, 0, 4], [0, 10, 3], [0, 0, 1.0]]), np.eye(4)
    steps = np.stack([depth, depth + 1])
    with h5py.File(_new(folder, "robomimic_hdf5") / "demo.hdf5", "w") as file:
        demo = file.create_group("data/demo_0")
        demo.attrs["camera_info"] = json.dumps({"front": {"intrinsics": matrix.tolist(), "extrinsics": pose.tolist()}})
        demo.create_dataset("obs/front_depth", data=(steps / 1000).astype(np.float32)[..., None], compression="gzip")
        demo["obs/front_image"], demo["obs/robot0_eef_pos"] = np.stack([color, color]), np.zeros((2, 3))
        demo["actions"] = np.zeros((2, 7))
    with h5py.File(_new(folder, "maniskill_h5") / "traj.h5", "w") as file:
        file.create_dataset(
            "traj_0/obs/sensor_data/c/depth", data=steps.astype(np.int16)[..., None], compression="gzip"
        )
        file["traj_0/obs/sensor_data/c/rgb"] = np.stack([color, color])
        file["traj_0/obs/sensor_param/c/intrinsic_cv"] = np.stack([matrix, matrix]).astype(np.float32)
        file["traj_0/obs/sensor_param/c/extrinsic_cv"] = np.stack([pose[:3], pose[:3]]).astype(np.float32)
        file["traj_0/obs/agent/qpos"], file["traj_0/actions"] = np.zeros((2, 9)), np.zeros((1, 7))
    for protocol in (2, 4):
        said = {"intrinsics": matrix, "near": 0.01, "poses": [pose, pose], "text": "take it", "count": np.int64(3)}
        made = _new(folder, "pickle", f"protocol_{protocol}") / "meta.pkl"
        made.write_bytes(pickle.dumps(said, protocol=protocol))


def _cloud_of(count: int) -> Any:
    from pcdata import PointCloud

    generator = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=generator)
    normals = torch.nn.functional.normalize(points + 0.1, dim=1)
    colors = torch.randint(0, 256, (count, 3), generator=generator) / 255
    return PointCloud(points=points, normals=normals, colors=colors, labels=torch.arange(count) % 3, frame_id="base")


def _write_clouds(folder: Path) -> None:
    from pcdata import write_pcd, write_ply

    cloud = _cloud_of(60)
    write_pcd(_new(folder, "pcd_binary") / "a.pcd", cloud)
    write_ply(_new(folder, "ply_binary") / "a.ply", cloud)
    rows = cloud.points.tolist()
    lines = "\n".join(" ".join(f"{value:.7g}" for value in row) for row in rows)
    head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
    head = f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n{head}POINTS {len(rows)}\n"
    (_new(folder, "pcd_ascii") / "a.pcd").write_text(f"{head}DATA ascii\n{lines}\n")
    columns = cloud.points.numpy().T.astype("<f4").tobytes()
    packed = b"".join(
        bytes([len(part) - 1]) + part for part in (columns[i : i + 32] for i in range(0, len(columns), 32))
    )
    content = struct.pack("<II", len(packed), len(columns)) + packed  # LZF with nothing repeated
    made = _new(folder, "pcd_binary_compressed") / "a.pcd"
    made.write_bytes(f"{head}DATA binary_compressed\n".encode() + content)
    for name, word, code in (("ply_ascii", "ascii", ""), ("ply_binary_big_endian", "binary_big_endian", ">")):
        head = f"ply\nformat {word} 1.0\nelement vertex {len(rows)}\n"
        head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
        body = f"{lines}\n".encode() if not code else cloud.points.numpy().astype(">f4").tobytes()
        (_new(folder, name) / "a.ply").write_bytes(head.encode() + body)


_POSE = "[[1, 0, 0, {0}], [0, 1, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]"

_CALIBRATION = f"""\
format: pcdata-calibration
version: 1
unit: metre
cameras:
  wrist:
    {{model: opencv, width: 640, height: 480, fx: 600.0, fy: 601.0, cx: 320.0, cy: 240.0,
      distortion: [0.1, -0.1, 0, 0, 0],
      evidence: {{method: board, num_observations: 20, residuals: {{rms_px: 0.21}}, date: '2026-01-31', notes: ok}}}}
  top: {{model: pinhole, width: 640, height: 480, fx: 500.0, fy: 500.0, cx: 319.5, cy: 239.5}}
transforms:
  base_from_wrist: {{matrix: {_POSE.format(0.1)}}}
  base_from_top: {{translation: [0, 0, 1], quaternion_xyzw: [1, 0, 0, 0]}}
"""

_ROBOT = "".join(
    f"  - name: p{n}\n    base_from_gripper: {{translation: [0.{n}, 0.1, 0.2], quaternion_xyzw: [0, 0, 0, 1]}}\n"
    f"    camera_from_target: {{translation: [0.1, 0.{n}, 0.5], rotation_vector: [0.1, 0.2, 0.{n}]}}\n"
    for n in range(4)
)

_PIPELINE = """\
depth:
  - MaskDepth: {near: 0.2, far: 1.5}
  - Deproject
cloud:
  - CropWorkspace: {lower: [-0.5, -0.5, 0.1], upper: [0.5, 0.5, 1.5], frame: camera}
  - VoxelDownsample: {voxel_size: 0.005}
augment:
  - RandomApply: {step: {RandomJitter: {sigma: 0.002}}, probability: 0.5}
output: {format: npz, compression: gzip}
loader: {batch_size: 4, num_workers: 0, seed: 3}
"""


def _write_texts(folder: Path) -> None:
    (_new(folder, "calibration_yaml") / "c.yaml").write_text(_CALIBRATION)
    (_new(folder, "pipeline_yaml") / "p.yaml").write_text(_PIPELINE)
    (_new(folder, "robot_poses_yaml") / "p.yaml").write_text("unit: metre\nposes:\n" + _ROBOT)
    poses = ("base_from_gripper", "camera_from_target")
    head = ",".join(["name", *(f"{pose}.{part}" for pose in poses for part in ("x", "y", "z", "qx", "qy", "qz", "qw"))])
    rows = [f"p{n},0.{n},0.1,0.2,0,0,0,1,0.1,0.{n},0.5,0,0,0.6,0.8" for n in range(4)]
    (_new(folder, "robot_poses_csv") / "p.csv").write_text("\n".join([head, *rows]) + "\n")


def _write_volume(path: Path) -> None:
    from pcdata import TSDFVolume, write_volume

    volume = TSDFVolume(voxel_size=0.05, truncation=0.15)
    for name in _TwoCaptures.ids:
        pose = torch.eye(4, dtype=torch.float64)[None]
        volume.integrate(replace(_TwoCaptures().load(name), world_from_camera=pose, frame_id="base"))
    write_volume(path, volume)


def _write_bags(folder: Path, depth: np.ndarray, color: np.ndarray) -> None:
    """Write what a RealSense records: of each stream a camera, a pose and images."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)

    def message(name: str, *fields: Any) -> Any:
        return store.types[name](*fields)

    head = message("std_msgs/msg/Header", 0, message("builtin_interfaces/msg/Time", 1, 0), "0")
    roi = message("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    shift, turn = message("geometry_msgs/msg/Vector3", 0.02, 0, 0), message("geometry_msgs/msg/Quaternion", 0, 0, 0, 1)
    unit = message("std_msgs/msg/Float32", 0.001)
    messages = [("/device_0/sensor_0/option/Depth Units/value", unit)]
    for number, (kind, encoding, pixels) in enumerate((("Depth", "mono16", depth), ("Color", "rgb8", color))):
        height, width = pixels.shape[:2]
        k = np.array([20, 0, 5.5, 0, 20, 4, 0, 0, 1.0])
        size = (head, height, width)
        rows = np.ascontiguousarray(pixels).reshape(height, -1).view(np.uint8)
        camera = (*size, "Brown Conrady", np.zeros(5), k, np.zeros(9), np.zeros(12), 0, 0, roi)
        image = (*size, encoding, 0, rows.shape[1], rows.reshape(-1))
        topic = f"/device_0/sensor_{number}/{kind}_0"
        messages += [
            (f"{topic}/info/camera_info", message("sensor_msgs/msg/CameraInfo", *camera)),
            (f"{topic}/tf/0", message("geometry_msgs/msg/Transform", shift, turn)),
            *[(f"{topic}/image/data", message("sensor_msgs/msg/Image", *image))] * 3,
        ]
    for name in ("none", "bz2", "lz4"):
        bag = Writer(_new(folder, "bag", name) / "a.bag")
        if name != "none":
            bag.set_compression(Writer.CompressionFormat[name.upper()])
        with bag as writer:
            topics: dict[str, Any] = {}
            for time, (topic, sent) in enumerate(messages):
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, sent.__msgtype__, typestore=store)
                writer.write(topics[topic], time * 33_000_000, store.serialize_ros1(sent, sent.__msgtype__))
