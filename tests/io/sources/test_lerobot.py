"""LeRobot datasets: the layouts of depth seen on the hub, each as others write it, and what hostile ones come to."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pcdata import open_source
from pcdata.errors import CaptureError, ConfigError, FrameError, IntrinsicsError, PcdataError, UnitError
from pcdata.functional.depth.quantized import QuantizedDepth
from pcdata.structures import DepthFrame, PointCloud
from tests import lerobot_datasets as made
from tests.lerobot_datasets import HEIGHT, IMAGE_NAMES, POSE, STEPS, WIDTH, K, number, tenths

IDS = ["000000-000000", "000000-000001", "000001-000000", "000001-000001", "000001-000002"]
LENS = [20.0, 21.0, 9.5, 7.5]
FLIPPED = [[-20.0, 0.0, 9.5], [0.0, -21.0, 7.5], [0.0, 0.0, 1.0]]


def metres(step: int) -> torch.Tensor:
    return torch.from_numpy((tenths(step).astype(np.float64) * 0.0001).astype(np.float32))[None]


def loaded(path: Path, **options: Any) -> list[DepthFrame]:
    source = open_source(path, **options)
    assert source.ids == IDS
    frames = [source.load(name) for name in (*source.ids[::-1], *source.ids)][len(IDS) :]  # in any order
    assert all(isinstance(frame, DepthFrame) for frame in frames)
    return frames


# -- depth -------------------------------------------------------------------------------------------------------------


def test_lossless_videos_come_back_bit_for_bit_with_color_lens_and_signals(tmp_path: Path) -> None:
    frames = loaded(made.lossless(tmp_path), metres_per_unit=0.0001, extrinsics="camera_to_frame", frame_id="base")
    for step, frame in enumerate(frames):
        assert torch.equal(frame.depth, metres(step))
        assert frame.camera.intrinsics[0].tolist() == K
        assert (frame.colors[0].int() - torch.from_numpy(made.color(step)).int()).abs().max() < 40
        assert torch.allclose(frame.world_from_camera[0], torch.tensor(POSE, dtype=torch.float64), atol=1e-6)
        assert frame.frame_id == "base"
        assert frame.signals["action"].tolist() == [[float(step), 0.0, 1.0]]
        assert frame.signals["observation.state"].tolist() == [[float(step), 0.5]]
        assert frame.signals["task"] == ("pick it up",)
        assert frame.provenance["cameras"] == ["front"]
        assert frame.provenance["metres_per_unit"] == 0.0001


def test_episodes_have_times_tasks_and_attributes(tmp_path: Path) -> None:
    episodes = open_source(made.lossless(tmp_path), metres_per_unit=0.0001).episodes
    assert [(one.id, one.first, one.length) for one in episodes] == [("episode_000000", 0, 2), ("episode_000001", 2, 3)]
    assert episodes[1].times == pytest.approx([0.0, 0.1, 0.2])
    assert episodes[1].attributes["tasks"] == ["pick it up"]
    assert episodes[1].attributes["robot_type"] == "made_up"
    assert episodes[0].attributes["names"] == {"observation.state": ["arm", "hand"]}


def test_what_nothing_states_is_asked_for_by_the_name_of_the_camera(tmp_path: Path) -> None:
    path = made.lossless(tmp_path)
    with pytest.raises(UnitError, match=r"unit of depth of camera 'front'.*metres_per_unit=0.0001"):
        open_source(path)
    info = json.loads((path / "meta/info.json").read_text())
    del info["features"]["front_camera_intrinsics"]
    made.write_json(path / "meta/info.json", info)
    with pytest.raises(IntrinsicsError, match="intrinsics of camera 'front'"):
        open_source(path, metres_per_unit={"front": 0.0001})
    frame = loaded(path, metres_per_unit=0.0001, intrinsics={"front": LENS})[0]
    assert frame.camera.intrinsics[0].tolist() == K
    assert any(
        "camera_extrinsics" in line for line in open_source(path, metres_per_unit=1e-4, intrinsics=LENS).unread()
    )


def test_quantized_depth_is_read_within_its_stated_error_and_its_clipped_ends_are_no_reading(tmp_path: Path) -> None:
    true = [metres(step)[0].numpy() for step in range(STEPS)]
    true[0][5, 5] = 12.0  # beyond the range
    for frame, depth in zip(loaded(made.quantized(tmp_path, true), intrinsics=LENS), true):
        had = (depth > 0) & (depth < 10)
        read = frame.depth[0].numpy()
        assert (read[~had] == 0).all()
        off = 1000 * np.abs(read[had] - depth[had]).max()
        assert 0 < off <= frame.provenance["depth_error_mm"] < 1
        assert frame.provenance["codec_is_lossless"] is True


def test_no_bound_is_stated_where_a_codec_lost_codes(tmp_path: Path) -> None:
    source = open_source(made.quantized(tmp_path, is_lossless=False), intrinsics=LENS)
    assert source.load(IDS[0]).provenance["depth_error_mm"] is None
    assert any("camera 'top'" in line and "has no bound" in line for line in source.unread())


@pytest.mark.parametrize("how", [{}, {"near": 0.2, "far": 2.0, "is_log": False}, {"near": 0.3, "far": 60.0}])
def test_the_stated_error_holds_at_every_code_and_is_no_wider_than_it_must(how: dict[str, Any]) -> None:
    quantized = QuantizedDepth(**how)
    near, far, shift = (np.float32(1000 * one) for one in (quantized.near, quantized.far, quantized.shift))
    codes, between = np.arange(1, 4094), np.array([-0.4999, 0.4999])
    places = (codes[:, None] + between) / 4095
    if quantized.is_log:
        low, high = np.log(near + shift), np.log(far + shift)
        depth = np.exp(np.float64(low) + places * np.float64(high - low)) - float(shift)
        share = (np.log(depth.astype(np.float32) + shift) - low) / (high - low)
    else:
        depth = float(near) + places * float(far - near)
        share = (depth.astype(np.float32) - near) / (far - near)
    read = quantized.decoded(np.rint(share * 4095).clip(0, 4095).astype(np.uint16))
    off = np.abs(1000 * read.astype(np.float64) - depth)
    stated = np.array([[1000 * quantized.error(float(one)) for one in row] for row in read[::97]])
    assert (off[::97] <= stated).all()
    assert (off[::97].max(1) > 0.98 * stated.max(1)).all()


def test_codes_are_spaced_as_the_feature_says() -> None:
    even = QuantizedDepth(near=0.0, far=4.095, is_log=False)
    assert even.decoded(np.array([0, 1, 4094, 4095])).tolist() == pytest.approx([0.0, 0.001, 4.094, 0.0])
    assert even.error(2.0) == pytest.approx(0.000502)
    default = QuantizedDepth()
    assert 1000 * 2 * default.error(1.0) == pytest.approx(1.5, abs=0.1)
    for wrong in ({"near": 1.0, "far": 1.0}, {"near": float("nan")}, {"shift": -0.01}):
        with pytest.raises(UnitError):
            QuantizedDepth(**wrong)


@pytest.mark.parametrize(
    ("write", "options", "tolerance"),
    [
        (made.arrays("float16", lambda n: metres(n)[0].numpy().astype(np.float16)), {}, 5e-4),
        (made.arrays("float32", lambda n: metres(n)[0].numpy()), {}, 0.0),
        (made.arrays("uint16", tenths, info={"unit": "millimeters"}), {}, None),
        (made.arrays("uint16", tenths), {"metres_per_unit": 0.0001}, 0.0),
    ],
    ids=["float16", "float32", "millimetres", "stated"],
)
def test_arrays_in_rows_are_depth(
    write: Callable[[Path], Path], options: dict[str, Any], tolerance: float | None, tmp_path: Path
) -> None:
    for step, frame in enumerate(loaded(write(tmp_path), extrinsics="frame_to_camera", **options)):
        expected = metres(step) if tolerance is not None else 10 * metres(step)
        assert torch.allclose(frame.depth, expected, rtol=0, atol=tolerance or 1e-6)
        assert frame.camera.intrinsics[0].tolist() == K
        inverse = torch.linalg.inv(torch.tensor(POSE, dtype=torch.float64))
        assert torch.allclose(frame.world_from_camera[0], inverse, atol=1e-6)


@pytest.mark.parametrize(("kind", "dtype"), [("PNG", np.uint16), ("TIFF", np.uint16), ("TIFF", np.float32)])
def test_image_features_are_depth_where_they_have_16_bits(kind: str, dtype: Any, tmp_path: Path) -> None:
    is_float = dtype is np.float32
    stored = [metres(n)[0].numpy() if is_float else tenths(n) for n in range(STEPS)]
    path = made.images(tmp_path, [made.png(one, kind) for one in stored], "m" if is_float else "mm")
    for step, frame in enumerate(loaded(path)):
        assert torch.allclose(frame.depth, metres(step) * (1 if is_float else 10), rtol=0, atol=1e-6)


def test_negative_focal_lengths_turn_the_camera_by_half(tmp_path: Path) -> None:
    path = made.per_frame(tmp_path, FLIPPED)
    frame = loaded(path)[0]
    assert frame.camera.intrinsics[0].tolist() == K
    turned = torch.tensor(POSE, dtype=torch.float64) @ torch.diag(torch.tensor([-1.0, -1, 1, 1], dtype=torch.float64))
    assert torch.allclose(frame.world_from_camera[0], turned, atol=1e-6)


@pytest.mark.parametrize(
    ("write", "camera", "options"),
    [
        (made.lossless, "front", {"metres_per_unit": 0.0001}),
        (made.lossless_v2, "cam_high", {"metres_per_unit": 0.0001}),
        (made.quantized, "top", {}),
        (made.arrays("float16", lambda n: tenths(n).astype(np.float16) / 8192), "cam_0", {}),
        (made.per_frame, "cam_0", {}),
        (made.raw, "camera", {}),
        (made.described_videos, "camera", {}),
        (made.images, "wrist", {}),
    ],
    ids=["ffv1", "version 2", "quantized", "float16", "per frame", "raw", "described", "images"],
)
def test_missing_intrinsics_are_asked_for_by_camera_in_every_layout(
    write: Callable[[Path], Path], camera: str, options: dict[str, Any], tmp_path: Path
) -> None:
    path = write(tmp_path)
    info = json.loads((path / "meta/info.json").read_text())
    info["features"] = {key: said for key, said in info["features"].items() if "intrinsic" not in key}
    made.write_json(path / "meta/info.json", info)
    with pytest.raises(IntrinsicsError, match=rf"intrinsics of camera '{camera}'; say intrinsics={{'{camera}':"):
        open_source(path, **options)
    with pytest.raises(ConfigError, match=f"'nobody'.*{camera}"):
        open_source(path, intrinsics={camera: LENS, "nobody": LENS}, **options)
    frame = open_source(path, intrinsics={camera: LENS}, **options).load(IDS[0])
    assert frame.camera.intrinsics[0].tolist() == K


def test_version_2_with_unlisted_lossless_videos_and_a_file_of_intrinsics(tmp_path: Path) -> None:
    path = made.lossless_v2(tmp_path)
    about = {"fx": 20.0, "fy": 21.0, "cx": 9.5, "cy": 7.5, "width": WIDTH, "height": HEIGHT}
    made.write_json(path / "meta/camera_intrinsics.json", {"cam_high": about})
    for step, frame in enumerate(loaded(path, metres_per_unit=0.0001)):
        assert torch.equal(frame.depth, metres(step))
        assert frame.camera.intrinsics[0].tolist() == K


def test_raw_numbers_and_described_videos_beside_the_features(tmp_path: Path) -> None:
    raw = made.raw(tmp_path / "raw")
    for step, frame in enumerate(loaded(raw, intrinsics=LENS)):
        assert torch.allclose(frame.depth, 10 * metres(step), rtol=0, atol=1e-6)
    (raw / "depth/episode_000001.bin").write_bytes(b"12")
    with pytest.raises(CaptureError, match="take 1920 bytes, but it has 2"):
        open_source(raw, intrinsics=LENS).load(IDS[2])

    beside = made.described_videos(tmp_path / "beside")
    for step, frame in enumerate(loaded(beside, intrinsics=LENS)):
        assert torch.allclose(frame.depth, torch.tensor((1000 + step) / 1000), rtol=0, atol=1e-6)


# -- clouds ------------------------------------------------------------------------------------------------------------


def test_clouds_are_read_without_the_points_that_are_none(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(0.2, 0.8, (STEPS, 20, 3)).astype(np.float32)
    valid = np.arange(20) < 15
    path = made.dataset(
        tmp_path,
        {
            "observation.pointcloud.xyz": number("float32", 20, 3),
            "observation.pointcloud.rgb": number("uint8", 20, 3),
            "observation.pointcloud.valid_mask": number("bool", 20),
        },
        {
            "observation.pointcloud.xyz": [*points],
            "observation.pointcloud.rgb": [np.full((20, 3), 51, np.uint8)] * STEPS,
            "observation.pointcloud.valid_mask": [valid] * STEPS,
        },
    )
    with pytest.raises(FrameError, match="frame_id=NAME"):
        open_source(path)
    made.write_json(path / "conversion_info.json", {"target_frame": "base_link", "unit": "meters"})
    source = open_source(path, signals={"observation.state": {"kind": "invariant"}})
    cloud = source.load(IDS[3])
    assert isinstance(cloud, PointCloud)
    assert (cloud.frame_id, cloud.num_points) == ("base_link", 15)
    assert np.array_equal(cloud.points.numpy(), points[3, :15])
    assert torch.allclose(cloud.colors, torch.tensor(0.2))
    assert cloud.signals["observation.state"].tolist() == [[3.0, 0.5]]


def test_clouds_that_may_be_normalized_need_their_unit(tmp_path: Path) -> None:
    path = made.dataset(
        tmp_path,
        {"observation.pointcloud": number("float32", 6, 4)},
        {"observation.pointcloud": [np.full((6, 4), 0.5, np.float32)] * STEPS},
    )
    with pytest.raises(UnitError, match="metres_per_unit=1"):
        open_source(path, frame_id="base")
    assert open_source(path, frame_id="base", metres_per_unit=1.0).load(IDS[0]).points.shape == (6, 3)


# -- options -----------------------------------------------------------------------------------------------------------


def test_kinds_of_signals_are_stated_and_cameras_chosen(tmp_path: Path) -> None:
    path = made.lossless(tmp_path)
    stated = {"action": {"kind": "position", "frame": "base"}, "observation.state": None}
    options = {"metres_per_unit": 0.0001, "extrinsics": "camera_to_frame", "frame_id": "base"}
    frame = open_source(path, signals=stated, **options).load(IDS[1])
    assert frame.recorded_signals["action"].kind == "position"
    assert "observation.state" not in frame.signals
    source = open_source(path, **options)
    assert source.signals(IDS[2]).keys() == source.load(IDS[2]).signals.keys()
    for wrong, words in [
        ({"camera": "frnt"}, "did you mean 'front'"),
        ({"camera": []}, "camera must be"),
        ({"extrinsics": "inverse"}, "frame_to_camera"),
        ({"signals": {"actoin": {"kind": "invariant"}}}, "did you mean 'action'"),
        ({"clouds": 1}, "true or false"),
        ({"intrinsics": [1, 2]}, "fx, fy, cx, cy"),
        ({"metres_per_unit": {"front": -1}}, "metres_per_unit"),
    ]:
        with pytest.raises((ConfigError, UnitError), match=words):
            open_source(path, **{**options, **wrong})


def test_pictures_of_depth_are_not_taken_for_depth(tmp_path: Path) -> None:
    key = "observation.images.top_depth"
    said = {"dtype": "video", "shape": [HEIGHT, WIDTH, 3], "names": IMAGE_NAMES, "info": {"is_depth_map": False}}
    made.video(
        tmp_path / f"videos/{key}/chunk-000/file-000.mp4", [made.color(0)] * STEPS, "libx264", "yuv420p", "rgb24"
    )
    with pytest.raises(CaptureError, match="pictures of depth made for viewing"):
        open_source(made.dataset(tmp_path, {key: said}, {}, [key]))


def child(source: Any, found: Any) -> None:
    found.put([float(source.load(name).depth.sum()) for name in source.ids])


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_worker_reads_with_files_of_its_own(method: str, tmp_path: Path) -> None:
    source = open_source(made.lossless(tmp_path), metres_per_unit=0.0001)
    sums = [float(source.load(name).depth.sum()) for name in source.ids]  # its videos are open now
    context = multiprocessing.get_context(method)
    found = context.Queue()
    worker = context.Process(target=child, args=(source, found))
    worker.start()
    assert found.get(timeout=120) == sums
    worker.join()
    assert [float(source.load(name).depth.sum()) for name in source.ids] == sums


# -- hostile files -----------------------------------------------------------------------------------------------------


def changed_info(**changes: Any) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        info = json.loads((root / "meta/info.json").read_text())
        made.write_json(root / "meta/info.json", info | changes)

    return change


def changed_rows(**columns: Any) -> Callable[[Path], None]:
    return lambda root: changed(root / "data/chunk-000/file-000.parquet", columns)


def changed_episodes(**columns: Any) -> Callable[[Path], None]:
    return lambda root: changed(root / "meta/episodes/chunk-000/file-000.parquet", columns)


def changed(path: Path, columns: dict[str, Any]) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = parquet.read_table(path).to_pylist()
    for name, values in columns.items():
        for row, value in zip(rows, values):
            row[name] = value
    parquet.write_table(pytest.importorskip("pyarrow").Table.from_pylist(rows), path)


def cut(name: str, share: float = 0.5) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        content = (root / name).read_bytes()
        (root / name).write_bytes(content[: int(len(content) * share)])

    return damage


def text(name: str, content: bytes) -> Callable[[Path], None]:
    return lambda root: (root / name).write_bytes(content) and None


ROWS, DEPTH = "data/chunk-000/file-000.parquet", "videos/depth.front/chunk-000/file-000.mkv"


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (changed_info(codebase_version="v9.9"), "codebase_version"),
        (changed_info(features=[1]), "features must be"),
        (changed_info(features={"a": {"shape": [-1]}}), "shape of 'a'"),
        (changed_info(fps=0), "fps must be"),
        (changed_info(data_path="../../{chunk_index:03d}/{file_index:03d}"), "leads out of the dataset"),
        (changed_info(data_path="/etc/passwd"), "leads out of the dataset"),
        (changed_info(video_path="{video_key.__class__}"), "leads out of the dataset|not known"),
        (changed_info(data_path="data/{chunk_index:0999999999d}"), "leads out of the dataset|not known"),
        (text("meta/info.json", b"[" * 100_000), "not valid JSON"),
        (cut(ROWS), "not a readable Parquet file"),
        (cut(DEPTH, 0.2), "no picture|not a readable video|damaged"),
        (text(DEPTH, b"\x1a\x45\xdf\xa3" + b"\0" * 200), "not a readable video"),
        (text(DEPTH, b"RIFF" + b"\0" * 200), "neither an .mp4 nor an .mkv"),
        (changed_rows(timestamp=[0.0, float("nan")]), "finite seconds"),
        (changed_rows(timestamp=[0.0, float("inf")]), "finite seconds"),
        (changed_rows(frame_index=[0, 7]), "count from 0"),
        (changed_rows(episode_index=[0, 1]), "should have 2 rows"),
        (changed_rows(episode_index=["a"] * STEPS), "must hold numbers"),
        (changed_rows(task_index=[5]), "task_index 5"),
        (changed_rows(action=[None, None]), "has no value"),
        (changed_rows(action=[[1.0] * 99]), "must hold \\[3\\] numbers"),
        (changed_rows(front_camera_intrinsics=[[1.0] * 7]), "must hold 4 or 9 numbers"),
        (changed_rows(front_camera_intrinsics=[[20.0, -21.0, 9.5, 7.5]]), "one focal length is negative"),
        (changed_rows(front_camera_extrinsics=[[[9.0] * 4] * 4]), "rigid|rotation|row"),
        (changed_episodes(dataset_from_index=[0, 1]), "before the end of another"),
        (changed_episodes(episode_index=[0, 0]), "one episode_index"),
        (changed_episodes(length=[2, 1 << 40]), "whole number|should have"),
        (changed_episodes(**{"data/file_index": [0.5, 0.5]}), "whole number"),
        (changed_episodes(**{"videos/depth.front/from_timestamp": [float("nan")]}), "must be seconds"),
        (changed_episodes(**{"videos/depth.front/from_timestamp": [50.0]}), "one after the other"),
        (changed_episodes(**{"videos/depth.front/to_timestamp": [0.1]}), "ends at 0.1 s"),
        (changed_episodes(**{"videos/depth.front/to_timestamp": [0.5]}), "before the end of another"),
        (changed_episodes(**{"videos/depth.front/from_timestamp": [0.0, 9.0],
                             "videos/depth.front/to_timestamp": [0.2, 9.3]}), "no picture"),
        (changed_episodes(**{"videos/depth.front/file_index": [7]}), "no such file"),
    ],
)  # fmt: skip
def test_hostile_datasets_are_refused_by_name(damage: Callable[[Path], None], words: str, tmp_path: Path) -> None:
    path = made.lossless(tmp_path / "set")
    damage(path)
    with pytest.raises(PcdataError, match=words):
        load_all(path)


def load_all(path: Path) -> None:
    source = open_source(path, kind="lerobot", metres_per_unit=0.0001, extrinsics="camera_to_frame", frame_id="base")
    for name in source.ids:
        source.load(name)


def test_no_step_is_read_where_times_and_video_contradict_each_other(tmp_path: Path) -> None:
    path = made.lossless(tmp_path / "set")
    changed_rows(timestamp=[0.0, 0.1, 0.0, 0.2, 0.4])(path)  # seconds twice as long as the video
    source = open_source(path, metres_per_unit=0.0001)
    assert torch.equal(source.load(IDS[1]).depth, metres(1))
    for name in IDS[2:]:
        with pytest.raises(CaptureError, match=r"last step at 0\.6 s, but the video of its episode ends at 0\.5 s"):
            source.load(name)


def test_links_out_of_a_dataset_are_followed_only_where_that_is_allowed(tmp_path: Path) -> None:
    path = made.lossless(tmp_path / "set")
    (tmp_path / "store").mkdir()
    (path / DEPTH).rename(tmp_path / "store" / "depth.mkv")
    (path / DEPTH).symlink_to(tmp_path / "store" / "depth.mkv")
    with pytest.raises(CaptureError, match="leads out of"):
        open_source(path, metres_per_unit=0.0001).load(IDS[0])
    assert open_source(path, metres_per_unit=0.0001, links_to=tmp_path / "store").load(IDS[0]).depth.max() > 0


def test_episodes_that_were_not_downloaded_are_left_out_and_told(tmp_path: Path) -> None:
    path = made.dataset_v2(tmp_path, {}, {})
    for episode, steps in enumerate(([0, 1], [2, 3, 4])):
        file = path / f"videos/chunk-000/observation.depth_ffv1.cam_high/episode_{episode:06d}.mkv"
        made.video(file, [tenths(step) for step in steps], "ffv1", "gray16le")
    (path / "data/chunk-000/episode_000000.parquet").unlink()
    source = open_source(path, metres_per_unit=0.0001, intrinsics=LENS)
    assert source.ids == IDS[2:]
    assert torch.equal(source.load(IDS[2]).depth, metres(2))
    assert "1 episodes whose rows are not there" in source.unread()


def test_what_not_all_cameras_have_is_told_and_read_of_one_camera_alone(tmp_path: Path) -> None:
    depth = [(tenths(step) * 0.0001).astype(np.float32) for step in range(STEPS)]
    root = made.dataset(
        tmp_path / "set",
        {
            **{f"observation.depth.{name}": number("float32", HEIGHT, WIDTH) for name in ("left", "right")},
            **{f"observation.intrinsic.{name}": number("float32", 3, 3) for name in ("left", "right")},
            "observation.images.left": {"dtype": "image", "shape": [HEIGHT, WIDTH, 3], "names": IMAGE_NAMES},
            "left_camera_pose": number("float32", 4, 4),
        },
        {
            **{f"observation.depth.{name}": depth for name in ("left", "right")},
            **{f"observation.intrinsic.{name}": [K] * STEPS for name in ("left", "right")},
            "observation.images.left": [made.png(made.color(step)) for step in range(STEPS)],
            "left_camera_pose": [POSE] * STEPS,
        },
    )
    source = open_source(root)
    both = source.load(source.ids[0])
    assert both.num_views == 2
    assert (both.colors, both.world_from_camera) == (None, None)
    assert [line.split(" of camera left")[0] for line in source.unread() if "of camera left" in line] == [
        "color observation.images.left",
        "poses left_camera_pose",
    ]
    left = open_source(root, camera="left")
    frame = left.load(left.ids[0])
    assert frame.colors is not None
    assert frame.world_from_camera is not None


@pytest.mark.parametrize("storage", ["array", "image"])
def test_the_unit_of_whole_numbers_in_rows_is_asked_for_with_those_that_fit(tmp_path: Path, storage: str) -> None:
    if storage == "array":
        root = made.arrays("uint16", tenths)(tmp_path / "set")
    else:
        root = made.images(tmp_path / "set", unit="")
        info = json.loads((root / "meta/info.json").read_text())
        info["features"]["observation.images.wrist_depth"]["info"] = {}
        (root / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(UnitError, match=r"may be .*metres_per_unit=0\.0001 \(half within"):
        open_source(root)
    depth = open_source(root, metres_per_unit=0.0001).load("000000-000000").depth
    assert torch.equal(depth[0], torch.from_numpy((tenths(0) * 0.0001).astype(np.float32)))
