"""Tiny captures in the layouts of published data sets, made in a folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

HEIGHT, WIDTH = 6, 8
MATRIX = [[10.0, 0.0, 3.5], [0.0, 11.0, 2.5], [0.0, 0.0, 1.0]]
INTRINSICS = (10.0, 11.0, 3.5, 2.5)
SIZE = (HEIGHT, WIDTH)


def image(path: Path, array: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(array).save(path)
    return path


def depth_mm(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(500, 1500, SIZE).astype(np.uint16)


def color(seed: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*size, 3)).astype(np.uint8)


def rotated(array: np.ndarray) -> np.ndarray:
    bits = array.astype(np.uint16)
    return (bits << 3) | (bits >> 13)


def turned(shift: float) -> np.ndarray:
    """A pose that is not its own inverse."""
    return np.array([[0, -1, 0, shift], [1, 0, 0, 0.2], [0, 0, 1, 0.5], [0, 0, 0, 1]], np.float64)


def rows(matrix: Any) -> str:
    return "\n".join(" ".join(f"{value:.9g}" for value in row) for row in np.asarray(matrix)) + "\n"


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def tum(root: Path, *, color_late: float = 0.01, poses: str | None = None) -> Path:
    times = [10.0, 10.1, 10.2]
    for number, time in enumerate(times):
        image(root / "depth" / f"{time:.6f}.png", depth_mm(number) * 5)
        image(root / "rgb" / f"{time + color_late:.6f}.png", color(number))
    write(root / "depth.txt", "# depth maps\n" + "".join(f"{t:.6f} depth/{t:.6f}.png\n" for t in times))
    late = [time + color_late for time in times]
    write(root / "rgb.txt", "# color images\n" + "".join(f"{t:.6f} rgb/{t:.6f}.png\n" for t in late))
    half = float(np.sqrt(0.5))
    given = f"9.95 0 0 0 0 0 0 1\n10.05 1 0 0 0 0 {half} {half}\n10.15 2 0 0 0 0 1 0\n10.25 3 0 0 0 0 1 0\n"
    write(root / "groundtruth.txt", given if poses is None else poses)
    return root


def sun3d(root: Path) -> Path:
    for number in range(3):
        image(root / "image" / f"{number + 1:07d}-{number * 33_000:012d}.jpg", color(number))
        image(root / "depth" / f"{number + 1:07d}-{number * 33_000 + 4_000:012d}.png", rotated(depth_mm(number)))
    write(root / "intrinsics.txt", rows(MATRIX))
    write(root / "extrinsics" / "20130101.txt", "".join(rows(turned(9)[:3]) for _ in range(3)))
    write(root / "extrinsics" / "20140101.txt", "".join(rows(turned(number)[:3]) for number in range(3)))
    return root


def nyu_raw(root: Path) -> Path:
    root.mkdir(parents=True, exist_ok=True)
    for number in range(2):
        disparity = np.random.default_rng(number).integers(600, 900, SIZE).astype(np.uint16)
        disparity[0, 0] = 2047
        content = b"P5 %d %d 65535\n" % (WIDTH, HEIGHT) + disparity.astype("<u2").tobytes()
        (root / f"d-129488636{number}.665-2143162870.pgm").write_bytes(content)
    return root


def scannet(root: Path) -> Path:
    for number in (0, 2, 10):
        image(root / "depth" / f"{number}.png", depth_mm(number))
        image(root / "color" / f"{number}.jpg", color(number, (12, 16)))
        write(root / "pose" / f"{number}.txt", rows(turned(number)))
    square = np.eye(4)
    square[:3, :3] = MATRIX
    write(root / "intrinsic" / "intrinsic_depth.txt", rows(square))
    square[:2, :3] = [[20, 0, 7.5], [0, 22, 5.5]]
    write(root / "intrinsic" / "intrinsic_color.txt", rows(square))
    for camera in ("depth", "color"):
        write(root / "intrinsic" / f"extrinsic_{camera}.txt", rows(np.eye(4)))
    return root


def open3d(root: Path) -> Path:
    poses = ""
    for number in range(3):
        image(root / "depth" / f"{number:05d}.png", depth_mm(number))
        image(root / "color" / f"{number:05d}.jpg", color(number))
        poses += f"{number} {number} {number + 1}\n{rows(turned(number))}"
    matrix = np.array(MATRIX).T.ravel().tolist()
    write(root / "camera_x.json", json.dumps({"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": matrix}))
    write(root / "trajectory.log", poses)
    return root


COLOR_FROM_DEPTH = np.array([[1, 0, 0, 0.0257], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64)


def apc(root: Path, *, without: str = "") -> Path:
    blocks = {
        "Color camera intrinsic matrix": 2 * np.array(MATRIX) - np.diag([0, 0, 1]),
        "Depth camera intrinsic matrix": MATRIX,
        "Depth-to-color camera extrinsic matrix": COLOR_FROM_DEPTH,
    }
    for number in (0, 1):
        image(root / f"frame-{number:06d}.depth.png", rotated(depth_mm(number) * 10))
        image(root / "raw" / f"frame-{number:06d}.depth.png", rotated(depth_mm(number + 5) * 10))
        title = f"Camera-to-world extrinsic matrix (camera pose) for frame-{number:06d}"
        blocks[title] = turned(number)
    image(root / "frame-000000.color.png", color(0))
    text = "# Environment: shelf\n# Bin ID: B\n\n"
    text += "\n".join(f"# {title}\n{rows(matrix)}" for title, matrix in blocks.items() if title != without)
    write(root / "cam.info.txt", text)
    return root


def bop(root: Path, tail: str = "", *, posed: bool = True) -> Path:
    cameras, objects = {}, {}
    for number in (0, 3):
        name = f"{number:06d}"
        image(root / f"depth{tail}" / f"{name}.png", depth_mm(number) * 10)
        image(root / f"rgb{tail}" / f"{name}.png", color(number))
        world_to_camera = np.linalg.inv(turned(number))
        k = [10.0 + number, 0.0, 3.5, 0.0, 11.0, 2.5, 0.0, 0.0, 1.0]
        cameras[str(number)] = {"cam_K": k, "depth_scale": 0.1}
        if posed:
            cameras[str(number)] |= {
                "cam_R_w2c": world_to_camera[:3, :3].ravel().tolist(),
                "cam_t_w2c": (1000 * world_to_camera[:3, 3]).tolist(),
            }
        pose = {"cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0.0, 0.0, 700.0]}
        objects[str(number)] = [{"obj_id": 5, **pose}, {"obj_id": 5, **pose}] if number == 0 else []
    for instance in (0, 1):
        mask = np.zeros(SIZE, np.uint8)
        mask[instance, :2] = 255
        image(root / f"mask_visib{tail}" / f"000000_{instance:06d}.png", mask)
    write(root / f"scene_camera{tail}.json", json.dumps(cameras))
    write(root / f"scene_gt{tail}.json", json.dumps(objects))
    return root


NEAR, FAR = 0.01, 3.2


def rlbench(root: Path, **changes: Any) -> Path:
    meta: dict[str, Any] = {}
    for camera in ("front", "wrist"):
        for step in (0, 20):
            metres = depth_mm(step).astype(np.float64) / 1000
            code = np.round((metres - NEAR) / (FAR - NEAR) * (2**24 - 1)).astype(np.int64)
            code[0, 0] = 2**24 - 1  # the far plane
            packed = np.stack([code >> 16, code >> 8 & 255, code & 255], -1).astype(np.uint8)
            ids = np.zeros((*SIZE, 3), np.uint8)
            ids[1, 1] = (7, 1, 0)  # 7 + 256
            image(root / f"{camera}_depth" / f"{step}.png", packed)
            image(root / f"{camera}_rgb" / f"{step}.png", color(step))
            image(root / f"{camera}_mask" / f"{step}.png", ids)
        meta[f"{camera}_camera_extrinsics"] = [turned(step).tolist() for step in range(21)]
        meta[f"{camera}_camera_intrinsics"] = [[-10.0, 0.0, 4.0], [0.0, -11.0, 3.0], [0.0, 0.0, 1.0]]
        meta[f"{camera}_camera_near"], meta[f"{camera}_camera_far"] = NEAR, FAR
    write(root / "meta_data.json", json.dumps(meta | changes))
    return root


def pairs(root: Path) -> Path:
    for number in (0, 1, 10):
        root.mkdir(parents=True, exist_ok=True)
        np.save(root / f"depth_{number:03d}.npy", (depth_mm(number) / 1000).astype(np.float32))
        image(root / f"color_{number:03d}.png", color(number))
    write(
        root / "phoxi.intr", json.dumps({"_fx": 10.0, "_fy": 11.0, "_cx": 3.5, "_cy": 2.5, "_width": 8, "_height": 6})
    )
    return root


K4A_LENS = [0.5, 0.5, 0.49, 0.49, 0.5, -0.02, -0.002, 0.9, 0.08, -0.01, 0, 0, -7e-05, 2e-05]


def azure_kinect(root: Path, frames: int = 2) -> Path:
    """Write a recording as the recorder does, in its smallest modes, but for the packing of depth."""
    av = pytest.importorskip("av")
    root.mkdir(parents=True, exist_ok=True)
    path = root / "recording.mkv"
    with av.open(str(path), "w", format="matroska") as container:
        container.metadata["K4A_DEVICE_SERIAL_NUMBER"] = "0123"
        tracks = {}
        for title, size, codec, pixels in (
            ("COLOR", (720, 1280), "mjpeg", "yuvj422p"),
            ("DEPTH", (288, 320), "ffv1", "gray16le"),
        ):
            stream = container.add_stream(codec, rate=30)
            stream.height, stream.width = size
            stream.pix_fmt = pixels
            stream.metadata["title"] = title
            tracks[title] = stream
        said = {
            "CalibrationInformation": {
                "Cameras": [
                    {
                        "Location": place,
                        "Intrinsics": {
                            "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
                            "ModelParameters": K4A_LENS,
                        },
                        "Rt": {"Rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "Translation": [shift, 0, 0]},
                    }
                    for place, shift in (("CALIBRATION_CameraLocationD0", 0), ("CALIBRATION_CameraLocationPV0", -0.03))
                ]
            }
        }
        container.add_attachment("calibration.json", "application/octet-stream", json.dumps(said).encode())
        for number in range(frames):
            for title, stream in tracks.items():
                if title == "DEPTH":
                    array = np.full((288, 320), 800 + number, np.uint16)
                    frame = av.VideoFrame.from_ndarray(array, format="gray16le")
                else:
                    array = np.full((720, 1280, 3), 40 * number, np.uint8)
                    frame = av.VideoFrame.from_ndarray(array, format="rgb24").reformat(format="yuvj422p")
                frame.pts = number
                container.mux(stream.encode(frame))
        for stream in tracks.values():
            container.mux(stream.encode(None))
    return path


CAPTURES = {
    "scannet": scannet,
    "tum": tum,
    "sun3d": sun3d,
    "nyu_raw": nyu_raw,
    "open3d": open3d,
    "apc": apc,
    "bop": bop,
    "rlbench": rlbench,
    "pairs": pairs,
    "azure_kinect": azure_kinect,
}
OPTIONS: dict[str, dict[str, Any]] = {"tum": {"intrinsics": INTRINSICS}, "nyu_raw": {"intrinsics": INTRINSICS}}
