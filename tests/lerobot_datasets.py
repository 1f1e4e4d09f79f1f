"""LeRobot datasets as others write them, by pyarrow and PyAV alone: two episodes of two and three steps."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

LENGTHS = (2, 3)
STEPS = sum(LENGTHS)
EPISODE_STEPS = ((0, 1), (2, 3, 4))
FPS = 10
HEIGHT, WIDTH = 16, 20  # x265 takes nothing lower
K = [[20.0, 0.0, 9.5], [0.0, 21.0, 7.5], [0.0, 0.0, 1.0]]
POSE = [[0.0, -1.0, 0.0, 0.3], [1.0, 0.0, 0.0, -0.1], [0.0, 0.0, 1.0, 0.5], [0.0, 0.0, 0.0, 1.0]]
IMAGE_NAMES = ["height", "width", "channels"]


def tenths(step: int) -> np.ndarray:
    """Depth of one step in tenths of a millimetre, with pixels that have none."""
    units = np.random.default_rng(step).integers(4000, 12000, (HEIGHT, WIDTH)).astype(np.uint16)
    units[:2, :3] = 0
    return units


def color(step: int) -> np.ndarray:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([10 * rows + 5 * step, 12 * columns, 0 * rows + 20 * step], axis=-1).astype(np.uint8)


def number(dtype: str, *shape: int) -> dict[str, Any]:
    return {"dtype": dtype, "shape": list(shape), "names": None}


def video(path: Path, pictures: Sequence[np.ndarray], codec: str, pixels: str, source: str = "gray16le") -> None:
    """Write pictures with the times of their steps."""
    av = pytest.importorskip("av")
    path.parent.mkdir(parents=True, exist_ok=True)
    kind = "matroska" if path.suffix == ".mkv" else "mp4"
    with av.open(str(path), "w", format=kind) as container:
        stream = container.add_stream(codec, rate=FPS)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = pixels
        stream.time_base = Fraction(1, FPS)
        if codec == "libx265":
            stream.options = {"x265-params": "lossless=1:bframes=0:log-level=none"}
        elif codec == "libx264":
            stream.options = {"crf": "10", "g": "2"}
        for place, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format=source)
            frame = frame if source == pixels else frame.reformat(format=pixels)
            frame.pts = place
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def png(array: np.ndarray, kind: str = "PNG") -> dict[str, Any]:
    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, format=kind)
    return {"bytes": buffer.getvalue(), "path": None}


def dataset(
    root: Path,
    features: Mapping[str, Mapping[str, Any]],
    columns: Mapping[str, Sequence[Any]],
    videos: Sequence[str] = (),
    **changes: Any,
) -> Path:
    """Write a dataset of version 3: features with the values of every step, and which videos the episodes are in."""
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    firsts = [sum(LENGTHS[:place]) for place in range(len(LENGTHS))]
    index = index_columns()
    rows = {"observation.state": [[float(step), 0.5] for step in range(STEPS)]} | dict(columns) | index
    episodes = [
        {
            "episode_index": place,
            "tasks": ["pick it up"],
            "length": length,
            "data/chunk_index": 0,
            "data/file_index": 0,
            "dataset_from_index": first,
            "dataset_to_index": first + length,
            **{
                f"videos/{key}/{name}": value
                for key in videos
                for name, value in (
                    ("chunk_index", 0),
                    ("file_index", 0),
                    ("from_timestamp", first / FPS),
                    ("to_timestamp", (first + length) / FPS),
                )
            },
        }
        for place, (first, length) in enumerate(zip(firsts, LENGTHS))
    ]
    info = {
        "codebase_version": "v3.0",
        "robot_type": "made_up",
        "total_episodes": len(LENGTHS),
        "total_frames": STEPS,
        "fps": FPS,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": {
            "observation.state": {**number("float32", 2), "names": ["arm", "hand"]},
            **features,
            **index_features(),
        },
    } | changes
    write_json(root / "meta/info.json", info)
    for name in ("meta/episodes/chunk-000", "data/chunk-000"):
        (root / name).mkdir(parents=True, exist_ok=True)
    parquet.write_table(arrow.Table.from_pylist(episodes), root / "meta/episodes/chunk-000/file-000.parquet")
    tasks = arrow.table({"task_index": [0], "task": ["pick it up"]})
    parquet.write_table(tasks, root / "meta/tasks.parquet")
    parquet.write_table(table_of(rows), root / "data/chunk-000/file-000.parquet")
    return root


def dataset_v2(
    root: Path, features: Mapping[str, Mapping[str, Any]], columns: Mapping[str, Sequence[Any]], **changes: Any
) -> Path:
    """Write a dataset of version 2.1: files of its own for every episode."""
    parquet = pytest.importorskip("pyarrow.parquet")
    index = index_columns()
    rows = {"observation.state": [[float(step), 0.5] for step in range(STEPS)]} | dict(columns) | index
    info = {
        "codebase_version": "v2.1",
        "fps": FPS,
        "chunks_size": 1000,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
        "features": {"observation.state": number("float32", 2), **features, **index_features()},
    } | changes
    write_json(root / "meta/info.json", info)
    lines = [{"episode_index": place, "tasks": ["pick"], "length": length} for place, length in enumerate(LENGTHS)]
    (root / "meta/episodes.jsonl").write_text("\n".join(map(json.dumps, lines)))
    (root / "meta/tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": "pick"}))
    (root / "data/chunk-000").mkdir(parents=True)
    first = 0
    for place, length in enumerate(LENGTHS):
        part = table_of(rows).slice(first, length)
        parquet.write_table(part, root / f"data/chunk-000/episode_{place:06d}.parquet")
        first += length
    return root


def table_of(rows: Mapping[str, Sequence[Any]]) -> Any:
    arrow = pytest.importorskip("pyarrow")
    columns = {}
    for name, values in rows.items():
        is_array = len(values) > 0 and isinstance(values[0], np.ndarray)
        columns[name] = nested(values) if is_array else arrow.array(list(values))
    return arrow.table(columns)


def nested(values: Sequence[np.ndarray]) -> Any:
    """Return arrays as lists of lists of their own dtype."""
    arrow = pytest.importorskip("pyarrow")
    stacked = np.stack(values)
    flat = arrow.array(stacked.reshape(-1))
    for side in reversed(stacked.shape[1:]):
        flat = arrow.ListArray.from_arrays(np.arange(0, len(flat) + 1, side, dtype=np.int32), flat)
    return flat


def index_columns() -> dict[str, list[Any]]:
    steps = [(place, step) for place, length in enumerate(LENGTHS) for step in range(length)]
    return {
        "timestamp": [np.float32(step / FPS) for _, step in steps],
        "frame_index": [step for _, step in steps],
        "episode_index": [place for place, _ in steps],
        "index": [*range(STEPS)],
        "task_index": [0] * STEPS,
    }


def index_features() -> dict[str, Any]:
    names = ("frame_index", "episode_index", "index", "task_index")
    return {"timestamp": number("float32", 1), **{name: number("int64", 1) for name in names}}


def write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


# -- layouts of the hub ------------------------------------------------------------------------------------------------


def lossless(root: Path) -> Path:
    """FFV1 depth in tenths of a millimetre, fx fy cx cy and extrinsics in columns."""
    video(root / "videos/depth.front/chunk-000/file-000.mkv", [tenths(n) for n in range(STEPS)], "ffv1", "gray16le")
    color_path = root / "videos/observation.images.front/chunk-000/file-000.mp4"
    video(color_path, [color(n) for n in range(STEPS)], "libx264", "yuv444p", "rgb24")
    return dataset(
        root,
        {
            "depth.front": {"dtype": "video", "shape": [HEIGHT, WIDTH, 1], "names": IMAGE_NAMES},
            "observation.images.front": {"dtype": "video", "shape": [HEIGHT, WIDTH, 3], "names": IMAGE_NAMES},
            "front_camera_intrinsics": number("float32", 4),
            "front_camera_extrinsics": number("float32", 4, 4),
            "action": number("float32", 3),
        },
        {
            "front_camera_intrinsics": [[20.0, 21.0, 9.5, 7.5]] * STEPS,
            "front_camera_extrinsics": [POSE] * STEPS,
            "action": [[float(n), 0.0, 1.0] for n in range(STEPS)],
        },
        ["depth.front", "observation.images.front"],
    )


def lossless_v2(root: Path) -> Path:
    """Version 2.1 with FFV1 depth that no feature lists."""
    dataset_v2(root, {}, {})
    for episode, steps in enumerate(EPISODE_STEPS):
        file = root / f"videos/chunk-000/observation.depth_ffv1.cam_high/episode_{episode:06d}.mkv"
        video(file, [tenths(step) for step in steps], "ffv1", "gray16le")
    return root


def quantized(root: Path, true: Sequence[np.ndarray] | None = None, is_lossless: bool = True) -> Path:
    """The format's own depth: 12-bit codes, even in log(metres + 3.5) from 0.01 m to 10 m, in HEVC."""
    key = "observation.images.top_depth"
    codes = [
        np.rint((np.log(np.maximum(one, 0.01) + 3.5) - np.log(3.51)) / (np.log(13.5) - np.log(3.51)) * 4095)
        .clip(0, 4095).astype(np.uint16)
        for one in true or [tenths(step) * 0.0001 for step in range(STEPS)]
    ]  # fmt: skip
    about: dict[str, Any] = {"is_depth_map": True, "depth_unit": "mm"}
    about |= {"video.extra_options": {"x265-params": "lossless=1"}} if is_lossless else {}
    video(root / f"videos/{key}/chunk-000/file-000.mp4", codes, "libx265", "gray12le", "gray12le")
    features = {key: {"dtype": "video", "shape": [HEIGHT, WIDTH, 1], "names": IMAGE_NAMES, "info": about}}
    return dataset(root, features, {}, [key])


def arrays(dtype: str, values: Callable[[int], np.ndarray], **said: Any) -> Callable[[Path], Path]:
    """Arrays in the rows, with matrices of the camera in columns."""

    def write(root: Path) -> Path:
        return dataset(
            root,
            {
                "observation.depth.cam_0": {**number(dtype, HEIGHT, WIDTH), **said},
                "observation.intrinsic.cam_0": number("float32", 3, 3),
                "observation.extrinsic.cam_0": number("float32", 4, 4),
            },
            {
                "observation.depth.cam_0": [values(step) for step in range(STEPS)],
                "observation.intrinsic.cam_0": [K] * STEPS,
                "observation.extrinsic.cam_0": [POSE] * STEPS,
            },
        )

    return write


def per_frame(root: Path, intrinsics: Sequence[Sequence[float]] = K) -> Path:
    """Float depth with the camera's matrices of every step under names without a camera."""
    return dataset(
        root,
        {
            "observation.depth.cam_0": number("float32", HEIGHT, WIDTH),
            "intrinsics": number("float32", 3, 3),
            "camera_pose": number("float32", 4, 4),
        },
        {
            "observation.depth.cam_0": [(tenths(step) * 0.0001).astype(np.float32) for step in range(STEPS)],
            "intrinsics": [intrinsics] * STEPS,
            "camera_pose": [POSE] * STEPS,
        },
    )


def images(root: Path, stored: Sequence[Mapping[str, Any]] | None = None, unit: str = "mm") -> Path:
    """Image files of 16 bits, or of floats, in the rows."""
    key = "observation.images.wrist_depth"
    said = {"dtype": "image", "shape": [HEIGHT, WIDTH, 1], "names": IMAGE_NAMES}
    return dataset(
        root,
        {
            key: {**said, "info": {"is_depth_map": True, "depth_unit": unit}},
            "wrist_intrinsics": number("float32", 3, 3),
        },
        {key: stored or [png(tenths(step)) for step in range(STEPS)], "wrist_intrinsics": [K] * STEPS},
    )


def raw(root: Path) -> Path:
    """Raw 16-bit numbers beside the features, a file an episode."""
    dataset(root, {}, {})
    (root / "depth").mkdir()
    for episode, steps in enumerate(EPISODE_STEPS):
        content = b"".join(tenths(step).astype("<u2").tobytes() for step in steps)
        (root / f"depth/episode_{episode:06d}.bin").write_bytes(content)
    write_json(root / "depth_config.json", {"width": WIDTH, "height": HEIGHT, "unit": "mm", "dtype": "uint16"})
    return root


def described_videos(root: Path) -> Path:
    """12-bit videos beside the features, even codes of millimetres: 1000 more than the step."""
    dataset(root, {}, {})
    episodes = {}
    for episode, steps in enumerate(EPISODE_STEPS):
        file = f"depth_videos/camera/episode_{episode:06d}.mp4"
        codes = [np.full((HEIGHT, WIDTH), 1000 + step, np.uint16) for step in steps]
        video(root / file, codes, "libx265", "gray12le", "gray12le")
        episodes[str(episode)] = {"chunk_index": 0, "file": file, "frame_count": len(steps)}
    about = {"shape": [HEIGHT, WIDTH, 1], "video.depth_min": 0.0, "video.depth_max": 4.095, "video.use_log": False}
    write_json(root / "depth_meta.json", {"sensors": {"camera": {**about, "episodes": episodes}}})
    return root
