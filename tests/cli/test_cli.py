"""The command line: exit codes, messages a tired person can act on, and nothing left behind."""

from __future__ import annotations

import errno
import fcntl
import functools
import importlib.util
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

import pcdata
from pcdata import CachedCloudDataset, PointCloud, extras
from pcdata.cli import main
from pcdata.io import write_ply
from pcdata.io.sources.cloud_files import CloudFilesSource
from pcdata.synthetic import SyntheticSource
from tests.io.forged import first_shard

ROOT = Path(__file__).resolve().parents[2]
CONFIG = """\
depth: [Deproject]
cloud: [FarthestPointSample: {num_points: 16, if_short: repeat}]
augment: [RandomRotation: {degrees: 90}]
"""


@pytest.fixture
def config(tmp_path) -> Path:
    (tmp_path / "config.yaml").write_text(CONFIG)
    return tmp_path / "config.yaml"


@pytest.fixture
def captures(tmp_path) -> Path:
    folder = tmp_path / "captures"
    folder.mkdir()
    for number in range(4):
        points = torch.rand(50, 3, generator=torch.Generator().manual_seed(number)) + 0.2
        write_ply(folder / f"scan{number}.ply", PointCloud(points=points, frame_id="camera"))
    return folder


def run(capsys, *arguments: object) -> tuple[int, str, str]:
    """Run in this process; return exit code, stdout, stderr."""
    try:
        code = main([str(argument) for argument in arguments])
    except SystemExit as leave:  # argparse
        code = leave.code or 0
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    return code, out, err


@contextmanager
def started(*arguments: object, **options: object) -> Iterator[subprocess.Popen]:
    """Run the command as a process of its own; it never outlives the test."""
    with subprocess.Popen(
        [sys.executable, "-m", "pcdata", *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"},
        **({"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | options),
    ) as process:
        try:
            yield process
        finally:
            process.kill()


# -- asking --------------------------------------------------------------------------------------------------------


def test_version(capsys):
    assert run(capsys, "--version") == (0, f"pcdata {pcdata.__version__}\n", "")


@pytest.mark.parametrize("arguments", [["--help"], ["build", "--help"], ["demo", "-h"], ["inspect", "-h"]])
def test_help_is_on_stdout(capsys, arguments):
    code, out, err = run(capsys, *arguments)
    assert (code, err) == (0, "")
    assert out.startswith("usage: pcdata")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["required", "COMMAND"]),
        (["biuld"], ["no command 'biuld'; did you mean 'build'", "pcdata --help lists them"]),
        (["build"], ["CONFIG", "--model"]),
        (["build", "--model", "dp3_sim"], ["frame"]),
        (["build", "c.yaml", "--source", "x", "--out", "y", "--limit", "0"], ["--limit", "at least 1", "'0'"]),
        (["build", "c.yaml", "--source", "x", "--out", "y", "--limit", "two"], ["--limit", "whole number", "'two'"]),
        (["demo", "--scenes", "-1"], ["--scenes"]),
        (["build", "c.yaml", "--source", "x", "--out", "y", "--metres-per-unit", "mm"], ["--metres-per-unit", "'mm'"]),
        (["inspect"], ["PATH"]),
    ],
)
def test_a_wrong_call_is_exit_2_with_the_reason_on_stderr(capsys, arguments, words):
    code, out, err = run(capsys, *arguments)
    assert (code, out) == (2, "")
    for word in words:
        assert word in err


# -- doctor --------------------------------------------------------------------------------------------------------


def test_doctor_tells_versions_backends_and_extras(capsys):
    code, out, err = run(capsys, "doctor")
    assert (code, err) == (0, "")
    for part in (pcdata.__version__, torch.__version__, "every operation, on any device", "torch_cluster", "open3d"):
        assert part in out
    assert max(map(len, out.splitlines())) <= 120


def test_doctor_says_all_of_a_long_reason_and_leaves_commands_whole(capsys, monkeypatch):
    command = "pip install ninja && pip install --no-build-isolation a-package-of-some-length"
    monkeypatch.setattr(extras, "why_missing", lambda module: f"{'it is needed for much ' * 8}: run {command}")
    code, out, err = run(capsys, "doctor")
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 120
    assert out.count(command) == len(extras.EXTRAS)
    assert " ".join(out.split()).count("it is needed for") == 8 * len(extras.EXTRAS)


def test_doctor_tells_what_to_install_for_what_is_absent(capsys, monkeypatch):
    find = importlib.util.find_spec
    gone = ("matplotlib", "open3d")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name in gone else find(name, *a))
    code, out, _ = run(capsys, "doctor")
    assert code == 0
    for module, command in (("matplotlib", 'pip install "pcdata[viz]"'), ("open3d", 'pip install "pcdata[open3d]"')):
        (row,) = re.findall(rf"^{module}(?:.*\n(?= ))*.*", out, re.MULTILINE)  # with the lines that go on with it
        assert "absent" in row
        assert command in row


# -- build ---------------------------------------------------------------------------------------------------------


def test_build_makes_a_dataset_and_tells_of_it(capsys, config, captures, tmp_path):
    code, out, err = run(capsys, "build", config, "--source", captures, "--out", tmp_path / "out")
    assert code == 0
    assert "4 samples" in out
    assert "FarthestPointSample" in out
    assert str(tmp_path / "out" / "load.py") in out
    assert CachedCloudDataset(tmp_path / "out").ids == ["scan0", "scan1", "scan2", "scan3"]
    # No terminal: plain lines, seldom, with rate and time left, no control characters.
    first, last = err.splitlines()
    assert re.fullmatch(r"build 1/4 scan0 [0-9.]+ s", first)
    assert re.fullmatch(r"build 4/4 scan3 [0-9.]+ s, [0-9.]+/s", last)
    assert "\r" not in err
    assert "\x1b" not in err


def test_limit_builds_the_first_captures_alone(capsys, config, captures, tmp_path):
    assert run(capsys, "build", config, "--source", captures, "--out", tmp_path / "out", "--limit", 2)[0] == 0
    assert CachedCloudDataset(tmp_path / "out").ids == ["scan0", "scan1"]
    code, _, _ = run(capsys, "build", config, "--source", captures, "--out", tmp_path / "all", "--limit", 99)
    assert code == 0
    assert len(CachedCloudDataset(tmp_path / "all")) == 4


def test_building_again_is_refused_until_overwrite_is_said(capsys, config, captures, tmp_path):
    call = ["build", config, "--source", captures, "--out", tmp_path / "out"]
    assert run(capsys, *call)[0] == 0
    code, out, err = run(capsys, *call)
    assert (code, out) == (1, "")
    assert "--overwrite" in err
    assert run(capsys, *call, "--overwrite", "--limit", 1)[0] == 0
    assert len(CachedCloudDataset(tmp_path / "out")) == 1


def test_overwrite_does_not_delete_somebody_s_files(capsys, config, captures, tmp_path):
    own = tmp_path / "own"
    own.mkdir()
    (own / "notes.txt").write_text("mine")
    code, _, err = run(capsys, "build", config, "--source", captures, "--out", own, "--overwrite")
    assert code == 1
    assert "not a pcdata dataset" in err
    assert (own / "notes.txt").read_text() == "mine"
    assert run(capsys, "build", config, "--source", captures, "--out", captures, "--overwrite")[0] == 2
    assert len(list(captures.iterdir())) == 4


def test_faults_of_the_configuration_are_exit_2_with_their_places(capsys, captures, tmp_path):
    (tmp_path / "bad.yaml").write_text("depth: [Deprojct]\noutput: {format: npz, compression: lzf}\n")
    code, out, err = run(capsys, "build", tmp_path / "bad.yaml", "--source", captures, "--out", tmp_path / "out")
    assert (code, out) == (2, "")
    assert "bad.yaml:1:9: unknown transform 'Deprojct'; did you mean 'Deproject'?" in err
    assert "bad.yaml:2:36: output.compression" in err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("source", "code", "words"),
    [
        ("nowhere", 1, ["nowhere", "no such file or folder"]),
        ("empty", 1, ["no known layout", "an empty folder", "intrinsics.json"]),
        ("config.yaml", 1, ["no known layout", "a .yaml file"]),
    ],
)
def test_a_source_that_is_none_is_exit_1_and_says_what_is_needed(capsys, config, tmp_path, source, code, words):
    (tmp_path / "empty").mkdir()
    got, out, err = run(capsys, "build", config, "--source", tmp_path / source, "--out", tmp_path / "out")
    assert (got, out) == (code, "")
    for word in words:
        assert word in err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("wrong", [["--kind", "foldr"], ["--kind", "clouds", "--metres-per-unit", "0"]])
def test_a_wrong_option_of_the_source_is_an_error_in_words(capsys, config, captures, tmp_path, wrong):
    code, _, err = run(capsys, "build", config, "--source", captures, "--out", tmp_path / "out", *wrong)
    assert code in (1, 2)
    assert err.startswith(("pcdata: ", "build 1/"))


def test_a_missing_configuration_is_exit_2(capsys, captures, tmp_path):
    code, _, err = run(capsys, "build", tmp_path / "no.yaml", "--source", captures, "--out", tmp_path / "out")
    assert code == 2
    assert "no.yaml" in err


def test_a_damaged_capture_is_quarantined_and_the_exit_code_says_so(capsys, config, captures, tmp_path):
    (captures / "scan2.ply").write_bytes((captures / "scan2.ply").read_bytes()[:-7])
    code, out, err = run(capsys, "build", config, "--source", captures, "--out", tmp_path / "out", "--max-bad", 0)
    assert (code, out) == (1, "")
    assert "'scan2': CaptureError: " in err
    assert "scan2.ply" in err
    assert "--max-bad" in err
    assert not (tmp_path / "out").exists()
    call = ["build", config, "--source", captures, "--out", tmp_path / "out"]
    for options, wanted in (([], 3), (["--overwrite", "--max-bad", 1], 0), (["--overwrite", "--max-bad", "25%"], 0)):
        code, out, err = run(capsys, *call, *options)
        assert code == wanted
        assert "1 capture failed twice, now quarantined: 1 CaptureError\n  scan2: CaptureError: " in out
    assert "quarantined" in run(capsys, "inspect", tmp_path / "out")[1]


@pytest.mark.parametrize("place", ["before", "after"])
def test_debug_shows_the_traceback(config, tmp_path, place):
    call = ["inspect", str(tmp_path / "nowhere")]
    with pytest.raises(pcdata.errors.CaptureError):
        main(["--debug", *call] if place == "before" else [*call, "--debug"])


# -- inspect -------------------------------------------------------------------------------------------------------


def test_inspect_tells_of_a_dataset(capsys, config, captures, tmp_path):
    run(capsys, "build", config, "--source", captures, "--out", tmp_path / "out")
    code, out, err = run(capsys, "inspect", tmp_path / "out")
    assert (code, err) == (0, "")
    for part in ("samples", "4", "hdf5", "16 fewest", "camera, m", "stored", "FarthestPointSample", "on the fly"):
        assert part in out


def test_inspect_tells_of_captures_and_of_one_file(capsys, captures):
    code, out, _ = run(capsys, "inspect", captures)
    assert code == 0
    assert "clouds" in out
    assert "scan0, scan1, scan2, ..." in out
    code, out, _ = run(capsys, "inspect", captures / "scan3.ply")
    assert code == 0
    assert "50 points" in out


def test_inspect_of_a_damaged_dataset_is_exit_1(capsys, config, captures, tmp_path):
    run(capsys, "build", config, "--source", captures, "--out", tmp_path / "out")
    (first_shard(tmp_path / "out") / "clouds.h5").write_bytes(b"x" * 100)
    code, out, err = run(capsys, "inspect", tmp_path / "out")
    assert (code, out) == (1, "")
    assert "clouds.h5" in err
    assert "rebuild" in err
    (tmp_path / "out" / "dataset.json").write_text("{")
    assert run(capsys, "inspect", tmp_path / "out")[0] == 1


@pytest.mark.parametrize("path", ["nowhere", ".", "config.yaml", "nul\0byte", "x" * 300])
def test_inspect_of_something_else_is_exit_1_in_words(capsys, config, tmp_path, path):
    code, out, err = run(capsys, "inspect", tmp_path / path)
    assert (code, out) == (1, "")
    assert err.startswith("pcdata: ")


def test_an_error_of_the_system_is_exit_1_without_traceback(capsys, captures, monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", "captures")

    monkeypatch.setattr("pcdata.io.open_source", refuse)
    code, out, err = run(capsys, "inspect", captures)
    assert (code, out) == (1, "")
    assert "Permission denied" in err


# -- demo ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("matplotlib") is None, reason="matplotlib is absent")
def test_the_demo_command_ends_with_dataset_picture_and_table(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr("pcdata.cli.demo.SyntheticSource", functools.partial(SyntheticSource, size=(120, 160)))
    code, out, err = run(capsys, "demo", tmp_path / "demo", "--scenes", 2)
    assert code == 0, err
    assert (tmp_path / "demo" / "demo.png").read_bytes().startswith(b"\x89PNG")
    assert len(CachedCloudDataset(tmp_path / "demo" / "dataset")) == 2
    assert "2 samples" in out
    assert "points after" in out
    assert "augmented points" in out
    assert [line.split()[:2] for line in err.splitlines()] == [["demo", "1/2"], ["demo", "2/2"]]


# -- signals and terminals -----------------------------------------------------------------------------------------


def test_the_command_line_works_in_a_thread_and_leaves_signal_handlers_alone(capsys, captures):
    before = signal.getsignal(signal.SIGTERM)
    codes = []
    thread = threading.Thread(target=lambda: codes.append(main(["inspect", str(captures)])))
    thread.start()
    thread.join()
    assert codes == [0]
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize("path", ["captures", "nowhere"])
def test_the_signal_handler_before_the_call_is_the_one_after_it(capsys, captures, path):
    def mine(number: int, frame: object) -> None:
        pass

    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        before = signal.signal(number, mine)
        try:
            main(["inspect", str(captures.parent / path)])
            assert signal.getsignal(number) is mine
        finally:
            signal.signal(number, before)


def test_ctrl_c_is_exit_130_in_words(capsys, captures, monkeypatch):
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pcdata.io.open_source", interrupt)
    code, _, err = run(capsys, "inspect", captures)
    assert code == 130
    assert "interrupted" in err


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_that_arrives_inside_a_destructor_is_not_lost(config, captures, tmp_path, monkeypatch, number):
    class Dropped:
        def __del__(self) -> None:
            os.kill(os.getpid(), number)
            time.sleep(0)  # the handler runs here, and Python drops what it raises

    load = CloudFilesSource.load

    def load_and_drop(self, sample_id: str) -> PointCloud:
        if sample_id == "scan1":
            Dropped()
        return load(self, sample_id)

    monkeypatch.setattr(CloudFilesSource, "load", load_and_drop)
    assert main(["build", str(config), "--source", str(captures), "--out", str(tmp_path / "out")]) == 128 + number
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_killed_build_leaves_nothing(config, tmp_path, number):
    many = tmp_path / "many"
    many.mkdir()
    write_ply(many / "scan0.ply", PointCloud(points=torch.rand(50, 3) + 0.2, frame_id="camera"))
    for copy in range(1, 3000):
        os.link(many / "scan0.ply", many / f"scan{copy}.ply")
    call = ["build", config, "--source", many, "--out", tmp_path / "result" / "out", "--workers", 0]
    with started(*call, "--set", "output.shard_size=3000") as process:
        assert process.stderr.readline().startswith("build 1/3000")
        assert [path.name for path in (tmp_path / "result").iterdir()] == [".out.building"]
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 128 + number, err[-2000:]
    assert err.splitlines()[-1].startswith("interrupted")
    assert out == ""
    assert not (tmp_path / "result").exists()


@pytest.mark.slow
def test_on_a_terminal_there_is_a_bar(config, captures, tmp_path):
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    call = ["build", config, "--source", captures, "--out", tmp_path / "out"]
    with started(*call, stderr=theirs, stdout=subprocess.DEVNULL) as process:
        os.close(theirs)
        seen, deadline = b"", time.monotonic() + 60
        while time.monotonic() < deadline:
            try:
                chunk = os.read(ours, 4096)
            except OSError:  # Linux: the other end is closed
                break
            if not chunk:
                break
            seen += chunk
        os.close(ours)
        assert process.wait(timeout=30) == 0
    assert b"\r" in seen
    assert b"4/4" in seen
    assert b"100%" in seen


@pytest.mark.slow
def test_a_reader_that_stops_reading_is_no_error(captures):
    with started("inspect", captures) as process:
        process.stdout.close()
        err = process.stderr.read()
        assert process.wait(timeout=60) == 0
    assert err == ""
