"""Names that would be obeyed, hide, or are no text at all: told as text, in the terminal, on pages and in JSON."""

from __future__ import annotations

import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from pcdata.cli.main import main
from pcdata.io import write_capture
from tests.factories import tabletop_frame

# As bytes on disk, and how each is told.
NAMES = {
    "no_utf8": (b"s\xff\xfe1", r"s\xff\xfe1"),
    "half_character": (b"h\xed\xa0\x80", r"h\xed\xa0\x80"),
    "right_to_left": ("evil\u202egnp.exe".encode(), "evil\\u202egnp.exe"),
    "terminal": (b"a\x1b[31mred\x1b]0;title\x07", "a\\x1b[31mred\\x1b]0;title\\x07"),
    "markup": (b"<script>alert(1)<", "<script>alert(1)<"),
    "long": (b"L" * 200, "L" * 200),
}
OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
CONFIG = "source: {path: somewhere}\ndepth:\n  - Deproject: {}\ncloud:\n  - RandomSample: {num_points: 64}\n"


def captures_in(folder: Path, *, texts: str = "") -> None:
    """Two captures of one camera; ``texts`` is what they say of themselves."""
    frame = tabletop_frame(1)
    if texts:
        frame = replace(frame, frame_id=texts, provenance={"sensor_name": texts, "serial": texts})
        frame = frame.with_signal("task", (texts,), "text")
    write_capture(frame, folder / "taken")
    view = folder / "taken" / "view0"
    for role in view.iterdir():
        for file in [*role.iterdir()] if role.is_dir() else []:
            shutil.copy(file, file.with_stem("1"))


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    """Run a command; nothing that it says may be obeyed by a terminal."""
    code = main([*words])
    said = capsys.readouterr()
    lines = re.sub("\r[^\n]*", "", said.err)  # of the progress bar
    for text in (said.out, lines):
        assert not OBEYED.search(text), ascii(text)
        text.encode()
    return code, said.out + lines


def check_files(folder: Path) -> list[str]:
    """Read every JSON and every page: UTF-8 without anything to be obeyed; return the texts of the JSON."""
    told = []
    for path in folder.rglob("*"):
        # A dataset keeps where its captures lie as Python has it, since it is opened again by that.
        if path.suffix == ".json" and path.is_file() and path.name != "dataset.json":
            told.append(json.dumps(json.loads(path.read_bytes()), ensure_ascii=False))
            told[-1].encode()  # no lone surrogate
        if path.suffix == ".html":
            page = path.read_bytes().decode()
            assert not OBEYED.search(page)
            assert "<script>alert(1)" not in page
    return told


@pytest.mark.parametrize("name", NAMES)
def test_folders_of_any_name_serve_every_command(capsys, tmp_path, name):
    raw, told = NAMES[name]
    captures_in(tmp_path)
    folder = tmp_path / os.fsdecode(raw)
    (tmp_path / "taken" / "view0").rename(folder)
    (tmp_path / "build.yaml").write_text(CONFIG)
    out = tmp_path / "out" / os.fsdecode(raw)
    out.mkdir(parents=True)

    def command(*words: str) -> tuple[int, str]:
        return run(capsys, *words)

    at = str(folder)
    assert command("inspect", at, "--json", f"{out}/inspect.json")[0] == 0
    assert command("validate", at, "--json", f"{out}/validate.json")[0] in (0, 1)
    assert command("grade", at, "--json", f"{out}/grade.json")[0] in (0, 1)
    assert command("report", at, "--out", f"{out}/report.html", "--samples", "1")[0] == 0
    assert command("evaluate", f"{at}/labels", f"{at}/labels", "--json", f"{out}/evaluate.json")[0] == 0
    assert command("convert", at, "--to", "folder", "--out", f"{out}/converted")[0] == 0
    assert command("clouds", at, "--out", f"{out}/clouds", "--quality", "labels")[0] == 0
    code, said = command("build", str(tmp_path / "build.yaml"), "--source", at, "--out", f"{out}/set")
    assert code == 0, said
    assert command("report", f"{out}/set", "--out", f"{out}/set.html")[0] == 0
    assert command("grade", f"{out}/set", "--json", f"{out}/set.json")[0] in (0, 1)
    code, said = command("report", f"{at}.not", "--out", f"{out}/none.html")
    assert code == 1
    assert told in said
    texts = check_files(out)
    assert len(texts) >= 4
    kept = told if name in ("no_utf8", "half_character") else raw.decode()  # in JSON everything that is text stays
    assert any(json.dumps(kept, ensure_ascii=False)[1:-1] in text for text in texts)


@pytest.mark.parametrize("name", ["right_to_left", "terminal", "markup", "long"])
def test_what_captures_say_of_themselves_is_told_as_text(capsys, tmp_path, name):
    text = os.fsdecode(NAMES[name][0])
    if name == "terminal":
        text = text.replace("\x07", "")
    captures_in(tmp_path, texts=text)
    at, out = str(tmp_path / "taken" / "view0"), tmp_path / "out"
    out.mkdir()
    assert run(capsys, "inspect", at, "--json", f"{out}/inspect.json")[0] in (0, 1)
    assert run(capsys, "validate", at, "--json", f"{out}/validate.json")[0] in (0, 1)
    assert run(capsys, "grade", at, "--json", f"{out}/grade.json")[0] in (0, 1)
    assert run(capsys, "report", at, "--out", f"{out}/report.html")[0] in (0, 1)
    check_files(out)


def test_captures_of_names_that_are_no_text_are_refused_with_their_bytes(capsys, tmp_path):
    captures_in(tmp_path)
    view = tmp_path / "taken" / "view0"
    for role in view.iterdir():
        for file in [*role.iterdir()] if role.is_dir() else []:
            file.rename(file.with_stem(os.fsdecode(b"c\xff") + file.stem))
    code, said = run(capsys, "report", str(view), "--out", str(tmp_path / "report.html"))
    assert code == 1
    assert r"b'c\xff0.png'" in said or r"b'c\xff0" in said
    assert "convmv" in said
