"""The configuration for several cameras, built from several cameras on disk."""

from __future__ import annotations

from pathlib import Path

import torch

from pcdata.cli import main
from pcdata.datasets import CachedCloudDataset
from pcdata.io import open_source
from pcdata.synthetic import tabletop
from tests.rigs import calibration_of, write_rig

CONFIG = Path(__file__).parents[2] / "configs" / "multiview_objects.yaml"


def test_three_cameras_on_disk_become_one_cloud_of_the_objects(tmp_path: Path, capsys) -> None:
    scene = tabletop(0, 5, 3, size=(240, 320))
    rig = write_rig(tmp_path / "rig", [scene.frame])
    calibration_of(scene.frame).save(tmp_path / "rig.yaml")
    reading = ["--calibration", str(tmp_path / "rig.yaml"), "--frame", "base"]
    out = tmp_path / "set"
    assert main(["build", str(CONFIG), "--source", str(rig), *reading, "--out", str(out)]) == 0
    cloud = CachedCloudDataset(out, augment=None)[0]
    ones = torch.ones(cloud.num_points, 1, dtype=torch.float64)
    metres = (torch.cat([cloud.points.double(), ones], 1) @ cloud.source_from_cloud[0].T)[:, :3]
    assert cloud.num_points == 4096
    assert set(cloud.extra["view"].tolist()) == {0, 1, 2}
    assert float(scene.surface_distance(metres).median()) < 0.003  # metres, the size of a voxel
    assert float(metres[:, 2].min()) > 0  # the table is gone
    assert open_source(out / "raw" / "f0").kind == "rig"
    capsys.readouterr()
    assert main(["inspect", str(rig), *reading]) == 0
    told = capsys.readouterr().out
    assert "left, right, top" in told
    assert "lead to 'base'" in told
