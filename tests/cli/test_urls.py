"""URLs on the command line: a build goes to one; whatever else cannot says so, and makes no folder called ``s3:``."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator

import pytest

from pcdata.cli.main import _parser, main


def leaves(parser: argparse.ArgumentParser, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], list]]:
    """Every command with its arguments."""
    groups = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    for group in groups:
        for name, below in group.choices.items():
            yield from leaves(below, (*words, name))
    if not groups:
        yield words, parser._actions


WRITERS = {words: actions for words, actions in leaves(_parser()) if any(one.dest == "out" for one in actions)}


def line_of(words: tuple[str, ...], actions: list, out: str) -> list[str]:
    """A line with all that the command needs, of which only --out is looked at."""
    line = [*words]
    for action in actions:
        own = {"out": out, "board": "chessboard:8x6:0.03"}
        value = own.get(action.dest, next(iter(action.choices), "1") if action.choices else "1")
        if not action.option_strings:
            line += [value] * (action.nargs if isinstance(action.nargs, int) else 1)
        elif action.required or action.dest == "out":
            line += [action.option_strings[0], value]
    return line


def test_the_commands_that_write_are_found():
    assert {("build",), ("convert",), ("export",), ("fuse",), ("demo",)} < WRITERS.keys()
    assert sum(words[0] == "calib" for words in WRITERS) >= 4


@pytest.mark.parametrize("words", sorted(WRITERS.keys() - {("build",)}), ids=" ".join)
@pytest.mark.parametrize("out", ["s3://bucket/x.yaml", "file:///tmp/x.yaml"])
def test_a_command_that_writes_to_the_disk_refuses_a_url(words, out, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    try:
        code = main(line_of(words, WRITERS[words], out))
    except SystemExit as ended:  # a value that the parser refuses: then this test says nothing
        pytest.fail(f"the line is not parsed: {ended}, {capsys.readouterr().err}")
    assert code == 2
    assert f"--out: {out} is a URL, and this works on the disk alone" in capsys.readouterr().err
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    "line",
    [["verify"], ["card"], ["split"], ["inspect"], ["validate"], ["export", "--to", "dp3", "--out", "o"],
     ["build", "--model", "dp3_sim", "--set", "frame=base", "--set", "crop=None", "--out", "o", "--source"]],
    ids=" ".join,
)  # fmt: skip
def test_what_reads_from_the_disk_alone_says_so_of_a_url(line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*line, "s3://bucket/x"]) != 0
    assert "s3://bucket/x is a URL, and this works on the disk alone: give a path" in capsys.readouterr().err
    assert os.listdir(tmp_path) == []


def test_a_build_goes_to_a_url_by_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cloud.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
        "0 0 0\n1 0 0\n0 1 0\n"
    )
    (tmp_path / "c.yaml").write_text("cloud: [Center]\n")
    line = ["build", "c.yaml", "--source", "cloud.ply", "--out", "memory://cli/set"]
    assert main([*line, "--dry-run"]) == 0
    assert main(line) == 0, capsys.readouterr().err
    assert "dataset  memory://cli/set\n" in capsys.readouterr().out
    assert main(line) == 1
    assert "memory://cli/set exists already" in capsys.readouterr().err
    assert sorted(os.listdir(tmp_path)) == ["c.yaml", "cloud.ply"]
