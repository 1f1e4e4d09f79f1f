"""Laws of everything that captures are written by: what is written is read back, whole or not at all."""

from __future__ import annotations

import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from pcdata import open_source
from pcdata.errors import CacheError, CaptureError, ConfigError, NoReadingError, PcdataError
from pcdata.geometry.lens_models import lens_row
from pcdata.io import WRITERS, SubsetSource, Writer, convert, register_writer
from pcdata.io.sources.capture_source import episodes_of, signals_of
from pcdata.io.writers.writer import KEPT
from pcdata.structures import DepthFrame
from tests.disk_limits import largest_file
from tests.exports.samples import tree
from tests.io.writers.made_captures import MadeCaptures, cut_to_episodes, made_captures, made_frame
from tests.warm import run_python

OPTIONS: dict[str, dict[str, Any]] = {"lerobot": {"color": "image", "fps": 10}}  # what loses least, by writer
IMAGES = {"color": "colors", "labels": "labels", "mask": "mask", "confidence": "confidence"}


@pytest.fixture(params=list(WRITERS))
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def written(made: MadeCaptures, kind: str, out: Path) -> Any:
    convert(made, kind, out, **OPTIONS.get(kind, {}))
    return open_source(out)


@pytest.mark.parametrize("views", [1, 2])
def test_what_a_writer_keeps_is_read_back_as_it_was(kind: str, views: int, tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures(views=views))
    source = written(made, kind, tmp_path / "out")
    keeps = WRITERS[kind].keeps
    assert len(source) == len(made)
    for name, read in zip(made.ids, map(source.load, source.ids)):
        frame = made.load(name)
        assert torch.equal(read.depth, frame.depth)
        assert torch.equal(read.camera.intrinsics, frame.camera.intrinsics)
        for role, attribute in IMAGES.items():
            if role in keeps:
                assert torch.equal(getattr(read, attribute), getattr(frame, attribute)), role
        if "lens" in keeps:
            assert torch.equal(read.camera.distortion, frame.camera.distortion)
        if "pose" in keeps:
            assert read.frame_id == "base"
            assert torch.allclose(read.world_from_camera, frame.world_from_camera, rtol=0, atol=1e-12)


def test_the_lenses_of_a_rig_come_back_by_their_models(kind: str, tmp_path: Path) -> None:
    rows = [
        lens_row("test", model, values)
        for model, values in (
            ("fisheye", [-0.005, 0.04, -0.03, 0.006]),
            ("inverse_brown_conrady", [-0.056, 0.068, 0.0004, 0.0007, -0.02]),
            ("f_theta", [0.3]),
            ("f_theta_polynomial", [0.01, -0.08, 0.02, -0.01]),
            ("inverse_f_theta_polynomial", [0.0, 0.0, 0.0, 0.0]),
        )
    ]
    camera = replace(made_frame(views=5).camera, distortion=torch.tensor(rows, dtype=torch.float64))
    source = written(cut_to_episodes(made_captures(4, views=5, camera=camera)), kind, tmp_path / "out")
    assert source.load(source.ids[0]).camera.lenses == camera.lenses


def test_signals_come_back_with_their_kinds_frames_and_types(kind: str, tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures())
    source = written(made, kind, tmp_path / "out")
    for name, own in zip(made.ids, source.ids):
        before, after = made.signals(name), source.load(own).recorded_signals
        assert {name: (one.kind, one.frame) for name, one in after.items()} == {
            name: (one.kind, one.frame) for name, one in before.items()
        }
        assert all(after[name].same_bits(before[name]) for name in before)
        assert all(one.same_bits(before[name]) for name, one in signals_of(source, own).items())


def test_episodes_come_back_with_times_and_attributes(kind: str, tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures())
    source = written(made, kind, tmp_path / "out")
    for before, after in zip(made.episodes, episodes_of(source), strict=True):
        assert (after.id, after.first, after.length) == (before.id, before.first, before.length)
        assert after.times == pytest.approx(before.times, abs=1e-9)
        assert before.attributes.items() <= after.attributes.items()


@pytest.mark.parametrize("lacks", ["colors", "labels", "world_from_camera", "recorded_signals", "size"])
def test_captures_that_differ_come_back_as_they_were_or_are_refused(kind: str, lacks: str, tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures(4))
    second = made.frames["001"]
    if lacks == "size":
        small = {role: getattr(second, role)[:, :6, :8] for role in ("depth", *IMAGES.values())}
        camera = second.camera.resized((6, 8))
        made.frames["001"] = replace(second, **small, camera=camera)
    elif lacks == "recorded_signals":
        kept = {name: one for name, one in second.recorded_signals.items() if name != "joints"}
        made.frames["001"] = replace(second, recorded_signals=kept)
    elif lacks == "world_from_camera":
        kept = {name: one for name, one in second.recorded_signals.items() if one.frame is None}
        made.frames["001"] = replace(second, world_from_camera=None, frame_id=None, recorded_signals=kept)
    else:
        made.frames["001"] = replace(second, **{lacks: None})
    if kind != "folder" or lacks not in ("recorded_signals", "size"):  # which a folder has of each capture
        with pytest.raises(CaptureError, match="apart"):
            convert(made, kind, tmp_path / "out", **OPTIONS.get(kind, {}))
        assert not (tmp_path / "out").exists()
        return
    source = written(made, kind, tmp_path / "out")
    for name, own in zip(made.ids, source.ids, strict=True):
        before, after = made.load(name), source.load(own)
        assert (after.size, after.recorded_signals.keys()) == (before.size, before.recorded_signals.keys())


def test_parts_of_an_episode_still_know_the_whole_so_that_no_split_parts_them(kind: str, tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures(7))
    made.episodes = [replace(one, id=f"set/{one.id}") for one in made.episodes]
    cut = SubsetSource(made, [name for name in made.ids if name != "003"])
    source = written(cut, kind, tmp_path / "out")
    assert [one.id for one in episodes_of(source)] == ["set/pick 0", "set/pick 1~0", "set/pick 1~1"]
    assert [one.whole for one in episodes_of(source)] == ["set/pick 0", "set/pick 1", "set/pick 1"]


def test_depth_that_is_no_whole_units_comes_back_bit_for_bit_or_the_loss_or_a_way_out_is_told(
    kind: str, tmp_path: Path
) -> None:
    first, second = made_frame(0), made_frame(1)
    odd = replace(second, depth=torch.where(second.depth > 0, second.depth + 1.2345e-5, 0.0))
    made = MadeCaptures({"000": first, "001": odd})
    options = OPTIONS.get(kind, {})
    if kind == "lerobot":  # its units are settled by the first capture
        with pytest.raises(CaptureError, match="depth=array to keep it as it is"):
            convert(made, kind, tmp_path / "out", **options)
        options = {**options, "depth": "array"}
    report = convert(made, kind, tmp_path / "out", **options)
    source = open_source(tmp_path / "out")
    largest = max(
        float((source.load(own).depth.double() - made.load(name).depth.double()).abs().max())
        for name, own in zip(made.ids, source.ids)
    )
    assert largest == pytest.approx(report.lost["depth"].metres if "depth" in report.lost else 0.0, abs=1e-9)


def test_the_report_counts_what_was_written(kind: str, tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures())
    seen: list[tuple[int, int, str]] = []
    report = convert(made, kind, tmp_path / "out", progress=lambda *step: seen.append(step), **OPTIONS.get(kind, {}))
    assert (report.kind, report.samples, report.episodes) == (kind, len(made), 2)
    assert report.size == sum(len(content) for content in tree(tmp_path / "out").values() if content)
    assert [number for number, _, _ in seen] == [*range(1, len(made) + 1)]
    lacking = set(KEPT) - WRITERS[kind].keeps
    assert {name for name in report.lost if "no place" in report.lost[name].how} == lacking
    assert all(report.lost[name].captures == len(made) for name in lacking)


def test_the_same_captures_give_the_same_bytes(kind: str, tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures())
    convert(made, kind, tmp_path / "once")
    time.sleep(0.01)
    convert(made, kind, tmp_path / "twice")
    assert tree(tmp_path / "once") == tree(tmp_path / "twice")


def test_what_is_there_is_never_written_over(kind: str, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("mine")
    with pytest.raises(CacheError, match="exists already, and nothing is written over"):
        convert(made_captures(), kind, tmp_path / "out")
    assert tree(tmp_path) == {"out": None, "out/mine": b"mine"}


def test_a_full_disk_leaves_nothing(kind: str, tmp_path: Path) -> None:
    with largest_file(60), pytest.raises(PcdataError, match="a file may not become so large"):
        convert(cut_to_episodes(made_captures()), kind, tmp_path / "out")
    assert tree(tmp_path) == {}


def test_an_interrupted_writer_leaves_nothing(kind: str, tmp_path: Path) -> None:
    def interrupt(done: int, total: int, sample_id: str) -> None:
        if done == 2:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        convert(cut_to_episodes(made_captures()), kind, tmp_path / "out", progress=interrupt)
    assert tree(tmp_path) == {}


KILLED = """
import os, signal, sys
from pcdata.io import convert
from tests.io.writers.made_captures import cut_to_episodes, made_captures
convert(
    cut_to_episodes(made_captures()), sys.argv[1], sys.argv[2],
    progress=lambda done, *_: os.kill(os.getpid(), signal.SIGKILL) if done == 2 else None,
)
"""


def test_what_a_killed_writer_left_is_no_capture_and_goes_with_the_next(kind: str, tmp_path: Path) -> None:
    done = run_python(KILLED, kind, str(tmp_path / "out"), folder=Path(__file__).parents[3])
    assert done.returncode != 0
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".")
    report = convert(cut_to_episodes(made_captures()), kind, tmp_path / "out", **OPTIONS.get(kind, {}))
    assert any(left.name in note for note in report.notes)
    assert [one.name for one in tmp_path.iterdir()] == ["out"]


def test_a_capture_that_cannot_be_read_stops_the_writer_and_leaves_nothing(kind: str, tmp_path: Path) -> None:
    made = cut_to_episodes(made_captures())
    made.frames["001"] = replace(made.frames["001"], depth=torch.zeros(1, 12, 16))
    with pytest.raises(NoReadingError) as e:
        convert(made, kind, tmp_path / "out")
    assert "--skip 001" in "".join(e.value.__notes__)
    assert tree(tmp_path) == {}


def test_a_folder_inside_the_captures_is_refused(kind: str, tmp_path: Path) -> None:
    convert(cut_to_episodes(made_captures()), "folder", tmp_path / "in")
    before = tree(tmp_path)
    with pytest.raises(ConfigError, match="inside the captures"):
        convert(tmp_path / "in", kind, tmp_path / "in" / "deep" / "out")
    assert tree(tmp_path) == before


def test_an_option_that_a_writer_has_not_is_refused(kind: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="has no option 'colour'"):
        convert(made_captures(), kind, tmp_path / "out", colour="no")


def test_clouds_are_refused_with_the_way_out(kind: str, tmp_path: Path) -> None:
    class Clouds(MadeCaptures):
        def load(self, sample_id: str) -> Any:
            return "no frame"

    with pytest.raises(ConfigError, match="is no depth image"):
        convert(Clouds(made_captures().frames), kind, tmp_path / "out")


def test_a_writer_must_be_complete_and_keep_what_captures_have() -> None:
    with pytest.raises(ConfigError, match="must be a dataclass"):
        register_writer(DepthFrame)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="does not say write"):
        register_writer(Writer)
