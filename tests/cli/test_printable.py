"""What a file says reaches a terminal as text, never as an order."""

from __future__ import annotations

import io
import os
import subprocess
import sys

import pytest

from pcdata.cli import main
from pcdata.cli.printable import printable, printable_output
from pcdata.errors import CacheError
from pcdata.io.store.sample_keys import key_of

ORDERS = {
    "escape": "\x1b]0;title\x07",
    "bell": "\x07",
    "carriage return": "good\rbad",
    "backspace": "good\b\b\b\bbad",
    "delete": "\x7f",
    "C1 control": "\x9b31m",
    "override": "\u202egnp.exe",
    "isolate": "\u2066a\u2069",
    "mark": "\u200f",
    "line separator": "\u2028",
    "byte that is no UTF-8": "caf\udce9",
    "half character": "\ud800",
    "NUL": "\0",
}


@pytest.mark.parametrize("name", ORDERS)
def test_characters_that_a_terminal_obeys_become_escapes(name):
    safe = printable(ORDERS[name])
    assert safe.isprintable()
    assert "\\" in safe
    safe.encode("utf-8")


def test_plain_words_of_any_script_stay():
    for text in ("depth: 0.5 m\n\ttab", "Müller 深度 глубина עומק", "naïve…°"):
        assert printable(text) == text


def test_a_stream_without_the_characters_gets_escapes(monkeypatch):
    raw = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", raw)
    with printable_output():
        print("é\x1b", end="", flush=True)
    assert raw.buffer.getvalue() == b"\\xe9\\x1b"


@pytest.mark.parametrize("name", ["escape", "bell", "carriage return", "backspace", "C1 control", "override"])
@pytest.mark.parametrize("command", ["inspect", "validate"])
def test_names_in_errors_are_printable(tmp_path, capsys, command, name):
    folder = tmp_path / f"a{ORDERS[name]}b"
    folder.mkdir()
    (folder / f"x{ORDERS[name]}.pcd").write_text("bad")
    assert main([command, str(folder)]) != 0
    told = capsys.readouterr()
    assert (told.out + told.err).replace("\n", "").replace("\t", "").isprintable()


@pytest.mark.parametrize("name", ["1\npcdata: passed", "1\r", "1\x1b[2J", "1\u2028"])
def test_a_sample_whose_name_could_write_lines_of_its_own_is_refused(tmp_path, capsys, name):
    (tmp_path / f"{name}.ply").write_text("bad")
    assert main(["inspect", str(tmp_path)]) == 1
    told = capsys.readouterr().err
    assert "must not have control characters" in told
    assert told.count("\n") == 1
    with pytest.raises(CacheError, match="in one line"):
        key_of("1\npcdata: passed")


def test_a_name_that_is_no_utf8_is_told(tmp_path):
    folder = os.fsencode(tmp_path) + b"/caf\xe9"
    try:
        os.mkdir(folder)
    except OSError:
        pytest.skip("this file system takes UTF-8 names only")
    command = [sys.executable, "-m", "pcdata", "inspect", os.fsdecode(folder)]
    told = subprocess.run(command, capture_output=True, env={**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0"})
    assert b"Traceback" not in told.stderr
    assert b"caf\\xe9" in told.stderr
    told.stderr.decode("ascii")
