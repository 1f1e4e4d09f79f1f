"""The command compare: exit codes, the page, the JSON, datasets and captures."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from pcdata.cli import main
from pcdata.rng import generator_for
from pcdata.structures import Camera
from pcdata.synthetic import tabletop
from pcdata.synthetic.viewpoints import look_at
from pcdata.transforms import RandomSensorNoise
from tests.validation.captures import store

CAMERA = Camera.pinhole(fx=153.6, fy=153.6, cx=79.5, cy=59.5, size=(120, 160))
POSE = look_at((0.0, -0.75, 0.65))[None]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two folders of captures of one kind, and one with noise."""
    folder = tmp_path_factory.mktemp("compare")
    for name, seed in (("a", 0), ("b", 50)):
        frames = [tabletop(seed + n, camera=CAMERA, world_from_camera=POSE).frame for n in range(5)]
        store(folder / name, frames)
    step = RandomSensorNoise(sensor="realsense_d435", strength=3.0)
    store(folder / "noisy", [step(one, generator=generator_for(0, 0, str(n))) for n, one in enumerate(frames)])
    (folder / "c.yaml").write_text("depth: [Deproject]\ncloud: [ToFrame: {frame: world}]\n")
    return folder


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    code = main([*map(str, words)])
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    return code, out, err


def test_the_exit_code_says_whether_a_difference_fails(capsys, made, tmp_path):
    code, out, _ = run(capsys, "compare", made / "a", made / "b")
    assert (code, out.splitlines()[0]) == (0, "compare: pass")
    page, told = tmp_path / "compare.html", tmp_path / "compare.json"
    code, out, err = run(capsys, "compare", made / "a", made / "noisy", "--out", page, "--json", told)
    assert (code, out.splitlines()[0]) == (1, "compare: fail")
    assert "RandomSensorNoise(" in out
    assert "trying noise" in err
    assert {one["name"] for one in json.loads(told.read_text())["differences"]} >= {"noise"}
    text = page.read_text(encoding="utf-8")
    assert not re.findall(r"(?:src|href)=[\"'](?!data:)", text)
    assert text.index("Verdict") < text.index("Noise by distance") < text.index("Every number")


def test_datasets_are_compared_with_datasets_and_captures(capsys, made, tmp_path):
    for name in ("a", "b"):
        assert run(capsys, "build", made / "c.yaml", "--source", made / name, "--out", tmp_path / name)[0] == 0
    assert run(capsys, "compare", tmp_path / "a", tmp_path / "b")[0] == 0
    code, out, _ = run(capsys, "compare", tmp_path / "a", made / "b")
    assert code == 0
    assert "not compared: the images of B" in out
    code, _, err = run(capsys, "compare", tmp_path / "a", tmp_path / "b", "--frame", "world")
    assert code == 2
    assert "both sources are datasets" in err


def test_so_many_captures_as_asked_for_are_read(capsys, made):
    _, out, _ = run(capsys, "compare", made / "a", made / "b", "--captures", 3)
    assert out.count("3 of 5 captures") == 2


def test_nothing_is_written_among_what_is_read(capsys, made):
    for option in ("--out", "--json"):
        for folder in ("a", "b"):
            code, _, err = run(capsys, "compare", made / "a", made / "b", option, made / folder / "depth" / "f0.png")
            assert code == 2
            assert option in err


def test_a_path_that_is_not_there_is_named(capsys, made):
    code, _, err = run(capsys, "compare", made / "a", made / "nothing")
    assert code in (1, 2)
    assert "nothing" in err
