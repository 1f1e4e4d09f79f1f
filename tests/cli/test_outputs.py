"""Files that commands write at their end: refused at their begin, and each of its own."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest
import torch

from pcdata import PointCloud, write_ply
from pcdata.cli import main
from pcdata.cli.outputs import text_files
from pcdata.errors import ConfigError, WriteError


@pytest.fixture
def clouds(tmp_path: Path) -> Path:
    (tmp_path / "clouds").mkdir()
    write_ply(tmp_path / "clouds" / "a.ply", PointCloud(points=torch.ones(3, 3), frame_id="base"))
    return tmp_path / "clouds"


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str]:
    code = main([*map(str, words)])
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    return code, err


COMMANDS = [("grade", "--json"), ("compare", "--json"), ("compare", "--out"), ("drift", "--json"), ("drift", "--out")]


@pytest.mark.parametrize(("command", "flag"), [*COMMANDS, ("report", "--out")])
def test_a_place_that_cannot_be_written_is_refused_before_the_work(
    capsys, clouds, tmp_path, command, flag, monkeypatch
):
    def worked(*_: object, **__: object) -> None:
        raise AssertionError("captures were read")

    monkeypatch.setattr("pcdata.io.sources.cloud_files.CloudFilesSource.load", worked)
    paths = [clouds] * (2 if command == "compare" else 1)
    code, err = run(capsys, command, *paths, flag, tmp_path / "none" / "x")
    assert code == 1
    assert f"{command} {flag}" in err
    assert "does not exist" in err


def test_two_files_are_two(capsys, clouds, tmp_path):
    for words in (["compare", clouds, clouds, "--json"], ["drift", clouds, "--json"], ["report", clouds, "--png"]):
        code, err = run(capsys, *words, tmp_path / "x.png", "--out", tmp_path / "x.png")
        assert code == 2
        assert "give two" in err
        assert not (tmp_path / "x.png").exists()


def test_a_reference_is_a_path_that_is_read(capsys, clouds, tmp_path):
    code, err = run(capsys, "drift", clouds, "--reference", "")
    assert code == 2
    assert "reference: is empty" in err
    (tmp_path / "first").mkdir()
    code, err = run(capsys, "drift", clouds, "--reference", tmp_path / "first", "--json", tmp_path / "first" / "d.json")
    assert code == 2
    assert "inside the captures" in err


def test_errors_name_the_file_that_they_are_of(tmp_path, monkeypatch):
    full = OSError(errno.ENOSPC, "No space left on device")

    def write_text(*_: object, **__: object) -> None:
        raise full

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_text", write_text)
        with pytest.raises(WriteError, match=r"^job --json: .*a.json: cannot be written"):  # noqa: SIM117
            with text_files("job", json=str(tmp_path / "a.json"), out=str(tmp_path / "b.html")) as write:
                write("json", "{}")
    with pytest.raises(BrokenPipeError), text_files("job", json=str(tmp_path / "a.json")):
        raise BrokenPipeError  # of the work, not of a file
    assert list(tmp_path.iterdir()) == []


def test_all_files_or_none(tmp_path):
    with text_files("job", json=str(tmp_path / "a.json"), out=None) as write:
        write("json", "{}")
        write("out", "dropped")
        assert not (tmp_path / "a.json").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
    with pytest.raises(ConfigError, match="--json and --out are one file"):  # noqa: SIM117
        with text_files("job", json=str(tmp_path / "a.json"), out=str(tmp_path / "." / "a.json")):
            raise AssertionError("the work began")
    assert (tmp_path / "a.json").read_text() == "{}"
