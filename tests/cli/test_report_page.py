"""The commands report and grade: pages that stand alone, exit codes, refusals."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pcdata import PointCloud, write_ply
from pcdata.cli import main
from pcdata.report.html.page import page_of
from pcdata.synthetic import tabletop
from tests.validation.captures import SIZE, scene, store


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    frames = list(scene(num_views=1).noisy_frames(3))
    frames = [replace(frame, colors=frame.colors ^ number) for number, frame in enumerate(frames)]  # type: ignore[operator]
    return store(tmp_path_factory.mktemp("report") / "capture", frames)


@pytest.fixture(scope="module")
def frozen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    frames = list(scene(num_views=1).noisy_frames(3))
    frames = [replace(frame, colors=frame.colors ^ number) for number, frame in enumerate(frames)]  # type: ignore[operator]
    folder = store(tmp_path_factory.mktemp("frozen") / "capture", frames)
    (folder / "depth" / "f1.png").write_bytes((folder / "depth" / "f0.png").read_bytes())
    return folder


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    code = main([*map(str, words)])
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    return code, out, err


def test_the_page_stands_alone(capsys, made, tmp_path):
    page = tmp_path / "report.html"
    code, out, _ = run(capsys, "report", made, "--out", page)
    assert code == 0
    assert re.match(r"grade    A: none of \d+ captures? warns or fails\n", out)
    text = page.read_text(encoding="utf-8")
    assert not re.findall(r"(?:src|href)=[\"'](?!data:|#)", text)
    assert "default-src 'none'" in text
    assert '<span class="grade A">A</span>' in text
    assert "No pipeline was given" in text


def test_what_is_wrong_comes_first(capsys, frozen, tmp_path):
    page = tmp_path / "report.html"
    code, out, _ = run(capsys, "report", frozen, "--out", page)
    assert code == 0
    assert "fail repeated_depth view 0, in 1 of 3 captures, first 'f1'" in out
    body = page.read_text(encoding="utf-8").split("<main>")[1]
    assert body.index('class="grade F"') < body.index("repeated_depth") < body.index("<canvas")
    assert body.index("What to do:") < body.index("<canvas")
    first = re.search(r'data-sample="0">show (\w+)<', body)
    assert first is not None
    assert first[1] == "f1"  # the worst is shown first


def test_captures_that_all_are_refused_are_told_and_no_success(capsys, tmp_path):
    for name in ("a", "b"):
        (tmp_path / "broken").mkdir(exist_ok=True)
        (tmp_path / "broken" / f"{name}.ply").write_bytes(b"no cloud")
    page, pictures = tmp_path / "report.html", tmp_path / "shown"
    code, out, _ = run(capsys, "report", tmp_path / "broken", "--out", page, "--png", pictures)
    assert code == 1
    assert out.startswith("grade    F: no capture could be read\n")
    assert "No capture could be read." in page.read_text(encoding="utf-8")
    assert (pictures / "summary.png").stat().st_size > 0
    code, out, _ = run(capsys, "grade", tmp_path / "broken")
    assert code == 1
    assert out.startswith("F: no capture could be read\n")
    torch.manual_seed(0)
    write_ply(tmp_path / "broken" / "c.ply", PointCloud(points=torch.rand(200, 3), frame_id="base"))
    code, out, _ = run(capsys, "report", tmp_path / "broken", "--out", page)
    assert code == 0  # one can be looked at
    assert "no capture" not in out


def test_a_cloud_without_points_is_not_good(capsys, tmp_path):
    (tmp_path / "clouds").mkdir()
    write_ply(tmp_path / "clouds" / "a.ply", PointCloud(points=torch.zeros(0, 3), frame_id="base"))
    code, out, _ = run(capsys, "grade", tmp_path / "clouds")
    assert code == 1
    assert "valid_fraction" in out
    assert "the cloud has no points" in out


def test_the_steps_of_a_pipeline_are_shown(capsys, made, tmp_path):
    config = tmp_path / "steps.yaml"
    config.write_text(
        "depth: [Deproject]\ncloud: [{FarthestPointSample: {num_points: 256}}]\naugment: [RandomJitter]\n"
    )
    assert run(capsys, "report", made, "--out", tmp_path / "r.html", "--config", config)[0] == 0
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "2. FarthestPointSample" in text
    index = json.loads(text.split('id="pcdata-index">')[1].split("</script>")[0])
    assert [stage["cloud"]["total"] for stage in index[0]["stages"]][-1] == 256
    assert "RandomJitter" in text  # the chain is told whole, its random steps are not run


def test_a_step_that_fails_is_told_and_the_capture_shown(capsys, made, tmp_path):
    config = tmp_path / "steps.yaml"
    config.write_text(
        "depth: [Deproject]\ncloud: [{CropWorkspace: {frame: camera, lower: [5, 5, 5], upper: [6, 6, 6], "
        "max_drop: 0.5}}]\n"
    )
    assert run(capsys, "report", made, "--out", tmp_path / "r.html", "--config", config)[0] == 0
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "max_drop" in text
    assert "<canvas" in text


def test_grade_is_for_a_nightly_job(capsys, made, frozen, tmp_path):
    assert run(capsys, "grade", made)[0] == 0
    code, out, _ = run(capsys, "grade", frozen, "--json", tmp_path / "g.json")
    assert code == 1
    assert re.match(r"F: \d+ of \d+ captures fail", out)
    assert json.loads((tmp_path / "g.json").read_text())["grade"] == "F"


def test_the_page_is_never_among_what_is_read(capsys, made):
    before = sorted(made.rglob("*"))
    code, _, err = run(capsys, "report", made, "--out", made / "depth" / "f0.png")
    assert code == 2
    assert "--out" in err
    assert sorted(made.rglob("*")) == before


def test_a_page_without_data_is_small():
    assert len(page_of("empty", [], [])) < 2_000_000


def test_drift_tells_a_moved_camera_by_its_exit_code(capsys, tmp_path):
    here = tabletop(0, size=SIZE).frame.world_from_camera
    there = here.clone()
    there[:, :3, 3] += torch.tensor([0.0, 0.006, 0.0])
    for name, poses in (("still", [here] * 2), ("moved", [here, there])):
        scenes = [tabletop(0, noise="stereo", size=SIZE, world_from_camera=pose) for pose in poses]
        frames = [scene.render(seed_noise=4 * n + k) for n, scene in enumerate(scenes) for k in range(4)]
        store(tmp_path / name, [replace(frame, world_from_camera=here) for frame in frames])
    code, out, _ = run(capsys, "drift", tmp_path / "still", "--window", 4)
    assert (code, out.splitlines()[0]) == (0, "drift: pass")
    page, told = tmp_path / "drift.html", tmp_path / "drift.json"
    code, out, _ = run(capsys, "drift", tmp_path / "moved", "--window", 4, "--out", page, "--json", told)
    assert (code, out.splitlines()[0]) == (1, "drift: fail")
    assert json.loads(told.read_text())["cameras"][0]["shift"] == pytest.approx(0.006, rel=0.2)
    assert "moved by" in page.read_text(encoding="utf-8")


def test_a_dataset_is_shown_and_graded_as_it_is(capsys, made, tmp_path):
    (tmp_path / "c.yaml").write_text("depth: [Deproject]\ncloud: [FarthestPointSample: {num_points: 64}]\n")
    assert run(capsys, "build", tmp_path / "c.yaml", "--source", made, "--out", tmp_path / "set")[0] == 0
    code, out, _ = run(capsys, "report", tmp_path / "set", "--out", tmp_path / "set.html")
    assert code == 0
    text = (tmp_path / "set.html").read_text(encoding="utf-8")
    assert "2. FarthestPointSample" in text.split('class="bars"')[1]  # the funnel of the build
    assert run(capsys, "grade", tmp_path / "set")[1][0] == out.split()[1][0]
    for option in (["--config", tmp_path / "c.yaml"], ["--limit", 1], ["--frame", "base"]):
        code, _, err = run(capsys, "report", tmp_path / "set", "--out", tmp_path / "set.html", *option)
        assert code == 2
        assert "is a dataset" in err
