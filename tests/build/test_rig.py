"""Several cameras on disk, one of them out of place: found, mended and built as docs/multi_view.md tells."""

from __future__ import annotations

import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pcdata.cli import main
from pcdata.datasets import CachedCloudDataset
from pcdata.io import open_source, write_calibration
from pcdata.synthetic import Miscalibration, Tabletop, tabletop
from pcdata.transforms import ClusterObjects, Compose
from tests.rigs import calibration_of, write_rig

ROOT = Path(__file__).parents[2]
CONFIG = "configs/multiview_objects.yaml"


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Tabletop:
    """Three cameras on disk as the page names them; the calibration has ``right`` 10 mm off."""
    made = tabletop(0, 12, 3, noise="stereo", size=(240, 320))
    wrong = Miscalibration(translation=[0, 0.01, 0], rotation_degrees=[0, 0, 0])
    frame = replace(made.frame, world_from_camera=wrong.apply(made.truth.world_from_camera, seed=0))
    write_calibration(tmp_path / "rig.yaml", calibration_of(frame))
    write_rig(tmp_path / "rig", [made.frame])
    (tmp_path / "configs").mkdir()
    shutil.copy(ROOT / CONFIG, tmp_path / CONFIG)
    monkeypatch.chdir(tmp_path)
    return made


@pytest.mark.slow
def test_the_page_s_commands_find_and_mend_a_camera_and_build_one_cloud(scene: Tabletop, capsys) -> None:
    pytest.importorskip("matplotlib")
    section = (ROOT / "docs" / "multi_view.md").read_text(encoding="utf-8").split("## Cameras on disk")[1]
    commands = [shlex.split(line)[1:] for line in section.splitlines() if line.startswith("pcdata ")]
    outcomes = [(" ".join(words[:2]) if words[0] == "calib" else words[0], main(words)) for words in commands]
    assert outcomes == [("inspect", 0), ("validate", 1), ("calib overlap", 1), ("calib refine", 0), ("build", 0)]
    told = capsys.readouterr().out
    assert all(f"{name}: 320x240, fx" in told for name in ("left", "right", "top"))
    assert "recalibrate view 1 (right)" in told
    cloud = CachedCloudDataset("dataset", augment=None)[0]
    ones = torch.ones(cloud.num_points, 1, dtype=torch.float64)
    metres = (torch.cat([cloud.points.double(), ones], 1) @ cloud.source_from_cloud[0].T)[:, :3]
    assert cloud.num_points == 4096
    assert set(cloud.extra["view"].tolist()) == {0, 1, 2}
    off = scene.surface_distance(metres[cloud.extra["view"] == 1])
    assert float(off.median()) < 0.004  # noise and voxels; 10 mm out of place would be 6 mm from the surfaces
    assert float(metres[:, 2].min()) > 0.002  # the table is gone
    assert open_source("dataset/shards/00000/raw/f0").kind == "rig"


def test_the_config_parts_objects_that_touch() -> None:
    pipeline = (ROOT / CONFIG).read_text(encoding="utf-8").split("\noutput:")[0]
    steps = Compose.from_yaml(pipeline)
    frame = tabletop(5, 6, 4, size=(240, 320), touching=True, floor=False).frame
    passing = steps.step_through(frame, generator=torch.Generator().manual_seed(0))
    found = next(cloud for step, cloud in passing if isinstance(step, ClusterObjects))
    assert len(found.meta[0]["objects"]) == 6
    assert len(found.meta[0]["touching"]["cuts"]) >= 5
