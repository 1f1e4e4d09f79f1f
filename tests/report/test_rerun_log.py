"""Recordings for Rerun: what is in the file, read back by Rerun itself; a clear word where it is missing."""

from __future__ import annotations

import importlib.util
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pcdata import Compose, DepthFrame
from pcdata.cli import main
from pcdata.errors import CaptureError, MissingExtraError, WriteError
from pcdata.report.rerun_log import save_rerun
from pcdata.transforms import ClusterObjects, Deproject, MergeViews, RemovePlane, ToFrame
from tests.disk_limits import largest_file
from tests.factories import tabletop_frame
from tests.validation.captures import scene, store

needs_rerun = pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason='pip install "pcdata[rerun]"')


class Few:
    """Two captures of two cameras, and one that cannot be read."""

    name, ids = "few", ["a", "damaged", "b"]

    def __len__(self) -> int:
        return 3

    def load(self, sample_id: str) -> DepthFrame:
        if sample_id == "damaged":
            raise CaptureError("damaged: cut short")
        return replace(tabletop_frame(2), provenance={"cameras": ["left $", "right/hand"]})


CHAIN = Compose(
    [
        Deproject(),
        ToFrame(frame="base"),
        MergeViews(),
        RemovePlane(up=(0, 0, 1), frame="base", max_tilt=0.3, keep="above"),
        ClusterObjects(eps=0.03, min_points=5, min_size=20),
    ]
)


def read(path: Path) -> dict[str, dict[str, list[Any]]]:
    """Return entity -> column -> values, one for each row."""
    chunk = pytest.importorskip("rerun.chunk", reason="an older Rerun reads files in another way")
    found: dict[str, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
    for one in chunk.RrdReader(str(path)).stream():
        rows = one.to_record_batch()
        for name in {*rows.schema.names} - {"log_time"}:
            found[one.entity_path][name] += rows.column(name).to_pylist()
    return found


@needs_rerun
def test_captures_and_steps_lie_on_the_time_line(tmp_path, capsys):
    assert save_rerun(tmp_path / "a.rrd", Few(), pipeline=CHAIN) == 2
    assert "left out damaged" in capsys.readouterr().err
    found = read(tmp_path / "a.rrd")
    frame = Few().load("a")
    left, right = r"/base/view\ 0\ \(left\ \$\)", r"/base/view\ 1\ \(right\/hand\)"
    assert found[f"{left}/image/depth"]["capture"] == [0, 2]
    assert found["/problems"]["capture"] == [1]
    for view, camera in enumerate((left, right)):
        pose = frame.world_from_camera[view]
        (moved,) = found[camera]["Transform3D:translation"][0]
        assert np.allclose(moved, pose[:3, 3])
        (turn,) = found[camera]["Transform3D:mat3x3"][0]
        assert np.allclose(np.array(turn).reshape(3, 3).T, pose[:3, :3], atol=1e-6)  # columns first
        (lens,) = found[f"{camera}/image"]["Pinhole:image_from_camera"][0]
        assert np.allclose(np.array(lens).reshape(3, 3).T, frame.camera.intrinsics[view])
        depth = np.array(found[f"{camera}/image/depth"]["DepthImage:buffer"][0][0], np.uint8).view(np.float32)
        assert np.array_equal(depth, frame.depth[view].flatten())
        assert f"{camera}/1 Deproject".replace(" D", r"\ D") in found
    clouds = dict(zip(("2 ToFrame", "5 ClusterObjects"), (r"/base/2\ ToFrame", r"/base/5\ ClusterObjects")))
    made = {type(step).__name__: cloud for step, cloud in CHAIN.step_through(frame)}
    points = np.array(found[clouds["5 ClusterObjects"]]["Points3D:positions"][0])
    assert np.array_equal(points.astype(np.float32), made["ClusterObjects"].points)
    boxes = found[rf"{clouds['5 ClusterObjects']}/around/objects"]
    assert len(boxes["Boxes3D:labels"][0]) == len(made["ClusterObjects"].labels.unique())
    # Every point lies in one of the boxes.
    inside = np.zeros(len(points), dtype=bool)
    for center, half, (x, y, z, w) in zip(
        *(boxes[f"Boxes3D:{name}"][0] for name in ("centers", "half_sizes", "quaternions"))
    ):
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        inside |= (abs((points - center) @ turn) <= np.array(half) + 1e-4).all(1)
    assert inside.all()


@needs_rerun
def test_the_command_writes_a_recording(tmp_path, capsys):
    captures = store(tmp_path / "capture", list(scene(num_views=1).noisy_frames(2)))
    assert main(["view", str(captures), "--rerun", "--out", str(tmp_path / "a.rrd")]) == 0
    assert "logged   2 of 2 captures" in capsys.readouterr().out
    assert (tmp_path / "a.rrd").read_bytes()[:3] == b"RRF"
    assert main(["view", str(captures), "--rerun", "--out", str(captures / "a.rrd")]) == 2
    assert "inside the captures" in capsys.readouterr().err


@needs_rerun
def test_a_full_disk_is_told_and_what_was_there_stays(tmp_path):
    (tmp_path / "a.rrd").write_bytes(b"old")
    with (
        largest_file(20_000),
        pytest.raises(WriteError, match=r"a\.rrd: cannot be written: a file may not become so large"),
    ):
        save_rerun(tmp_path / "a.rrd", Few())
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("a.rrd", b"old")]


@needs_rerun
def test_an_interrupt_ends_it(tmp_path):
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        save_rerun(tmp_path / "a.rrd", Few(), progress=interrupt)
    assert list(tmp_path.iterdir()) == []


@needs_rerun
def test_without_a_display_no_window_is_tried(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["view", str(tmp_path), "--rerun"]) == 2
    assert "write a recording with --out FILE.rrd" in capsys.readouterr().err


def test_without_rerun_the_command_is_told(tmp_path, capsys, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "rerun" else find(name))
    with pytest.raises(MissingExtraError, match=r'run pip install "pcdata\[rerun\]"'):
        save_rerun(tmp_path / "a.rrd", Few())
    assert main(["view", str(tmp_path), "--rerun", "--out", str(tmp_path / "b.rrd")]) in (1, 2)
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize(
    ("words", "said"),
    [(["--out", "a.rrd"], "is of --rerun"), (["--rerun", "--port", "8000"], "has neither --port nor --no-open")],
)
def test_options_that_do_not_fit_are_refused(tmp_path, capsys, words, said):
    assert main(["view", str(tmp_path), *words]) == 2
    assert said in capsys.readouterr().err


def test_labels_beyond_the_classes_of_rerun_stay_classes():
    from pcdata.report.rerun_log import _classes

    assert _classes(torch.tensor([-1, 0, 65534, 65535])).tolist() == [65535, 0, 65534, 0]
