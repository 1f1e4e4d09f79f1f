"""The command view: an address, one that only this machine knows, and an end by Ctrl-C that is no fault."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from pcdata import PointCloud
from pcdata.cli import main
from pcdata.io import open_source
from pcdata.report.serving.samples import Samples
from tests.validation.captures import scene, store


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return store(tmp_path_factory.mktemp("view") / "capture", list(scene(num_views=1).noisy_frames(2)))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_command_serves_until_it_is_interrupted(captures, tmp_path, number):
    config = tmp_path / "steps.yaml"
    config.write_text("depth: [Deproject]\ncloud: [{FarthestPointSample: {num_points: 100}}]\n")
    process = subprocess.Popen(
        [sys.executable, "-m", "pcdata", "view", str(captures), "--no-open", "--config", str(config)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )
    try:
        assert process.stdout is not None
        told = [process.stdout.readline() for _ in range(3)]
        found = re.search(r"http://127\.0\.0\.1:(\d+)/\S{32}/", told[1])
        assert found, told
        assert f"ssh -L {found[1]}:127.0.0.1:{found[1]} HOST" in told[2]
        with urllib.request.urlopen(f"{found[0]}sample/1", timeout=60) as answer:
            said = json.load(answer)
        assert [stage["caption"] for stage in said["stages"]] == ["1. Deproject", "2. FarthestPointSample"]
        assert said["stages"][1]["cloud"]["count"] == 100
        assert len(said["pictures"]) == 2
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(f"http://127.0.0.1:{found[1]}/", timeout=60)
    finally:
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
    by_hand = number == signal.SIGINT
    assert process.returncode == (0 if by_hand else 128 + number)
    assert out == ("ended\n" if by_hand else "")
    assert err == ("" if by_hand else "interrupted; nothing half-written was left behind\n")
    assert [file.name for file in tmp_path.iterdir()] == ["steps.yaml"]


def test_a_page_is_opened_as_it_is(tmp_path, capsys, monkeypatch):
    import webbrowser

    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) or True)
    monkeypatch.setenv("DISPLAY", ":9")
    page = PointCloud(points=scene(num_views=1).frame.depth.new_zeros(3, 3), frame_id="base").show()
    page.save(tmp_path / "a page.html")
    assert main(["view", str(tmp_path / "a page.html")]) == 0
    assert opened == [(tmp_path / "a page.html").as_uri()]
    assert main(["view", str(tmp_path / "a page.html"), "--no-open"]) == 0
    assert len(opened) == 1


def test_without_a_display_no_browser_takes_the_terminal(tmp_path, capsys, monkeypatch):
    import webbrowser

    monkeypatch.setattr(webbrowser, "open", lambda address: pytest.fail("opened"))
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "a.html").write_text("<p>")
    assert main(["view", str(tmp_path / "a.html")]) == 0
    assert "there is no display" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["{captures}/nothing"], 1, "nothing"),
        (["{captures}", "--port", "70000"], 2, "from 0 to 65535"),
        (["{captures}", "--port", "x"], 2, "from 0 to 65535"),
        (["{captures}", "--config", "missing.yaml"], 2, "missing.yaml"),
    ],
)
def test_a_wrong_call_is_told_in_words(captures, capsys, words, code, said):
    try:
        ended = main(["view", "--no-open", *(word.format(captures=captures) for word in words)])
    except SystemExit as error:
        ended = error.code
    assert ended == code
    assert said in capsys.readouterr().err


def test_a_link_that_leads_out_is_refused(tmp_path):
    folder = store(tmp_path / "capture", list(scene(num_views=1).noisy_frames(2)))
    secret = tmp_path / "secret.png"
    (folder / "depth" / "f1.png").rename(secret)
    (folder / "depth" / "f1.png").symlink_to(secret)
    samples = Samples(open_source(folder))
    assert samples.description(0)["problem"] == ""
    refused = samples.description(1)
    assert "outside" in refused["problem"]
    assert refused["stages"] == []
    assert refused["pictures"] == []
