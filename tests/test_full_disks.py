"""Every single file that is written, on a disk that is full or takes no files: one error, and nothing half-written."""

from __future__ import annotations

import os
from dataclasses import replace

import pytest
import torch

from pcdata.build import build_dataset, config_from_yaml
from pcdata.cli import main
from pcdata.errors import PcdataError
from pcdata.io import (
    write_calibration,
    write_color,
    write_depth,
    write_labels,
    write_mask,
    write_pcd,
    write_ply,
    write_volume,
)
from pcdata.io.calibration.capture_camera import write_pose
from pcdata.io.images.confidence import write_confidence
from pcdata.io.writers.capture_folder import write_capture
from pcdata.report.pipeline_figure import save_pipeline_figure
from pcdata.structures import TSDFVolume
from pcdata.structures.calibration import Calibration
from tests.disk_limits import largest_file
from tests.exports.samples import Samples, cloud, frame, tree

VIEW = frame((24, 32))


def volume() -> TSDFVolume:
    made = TSDFVolume(voxel_size=0.1)
    made.integrate(replace(VIEW, labels=None))
    return made


WRITERS = {
    "a.ply": lambda path: write_ply(path, cloud()),
    "ascii.ply": lambda path: write_ply(path, cloud(), encoding="ascii"),
    "mesh.ply": lambda path: write_ply(path, volume().extract_mesh()),
    "a.pcd": lambda path: write_pcd(path, cloud()),
    "packed.pcd": lambda path: write_pcd(path, cloud(), encoding="binary_compressed"),
    "volume.npz": lambda path: write_volume(path, volume()),
    "cell.yaml": lambda path: write_calibration(
        path, Calibration(transforms={"a_from_b": torch.eye(4, dtype=torch.float64)})
    ),
    "depth.png": lambda path: write_depth(path, VIEW.depth[0], metres_per_unit=0.001),
    "color.png": lambda path: write_color(path, VIEW.colors[0]),
    "labels.png": lambda path: write_labels(path, VIEW.labels[0], background_label=9),
    "mask.png": lambda path: write_mask(path, VIEW.mask[0]),
    "confidence.png": lambda path: write_confidence(path, VIEW.mask[0].to(torch.uint8)),
    "pose.txt": lambda path: write_pose(path, VIEW.world_from_camera[0]),
    "figure.png": lambda path: save_pipeline_figure(path, VIEW, [("cloud", cloud())]),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_one_error_that_names_the_file_and_what_was_there_stays(tmp_path, name):
    (tmp_path / name).write_text("old")
    with largest_file(20), pytest.raises(PcdataError, match="cannot be written: a file may not become so large") as e:
        WRITERS[name](tmp_path / name)
    assert str(tmp_path / name) in str(e.value)
    assert tree(tmp_path) == {name: b"old"}


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="no folder that takes no files, even of root")
@pytest.mark.parametrize("name", WRITERS)
def test_a_folder_that_takes_no_files_is_one_error_that_names_the_file(name):
    with pytest.raises(PcdataError, match="cannot be written") as e:
        WRITERS[name](f"/proc/self/{name}")
    assert f"/proc/self/{name}" in str(e.value)


@pytest.mark.parametrize("command", ["validate", "check"])
def test_a_report_that_does_not_fit_is_one_line_and_leaves_nothing(tmp_path, capsys, command):
    if command == "validate":
        write_capture(VIEW, tmp_path / "in")
        call = ["validate", str(tmp_path / "in" / "view0")]
    else:
        build_dataset(config_from_yaml("cloud: [Center]\n"), Samples({"a": cloud(1024)}), tmp_path / "in")
        call = ["check", str(tmp_path / "in"), "--model", "dp3_sim"]
    before = tree(tmp_path)
    with largest_file(200):
        code = main([*call, "--json", str(tmp_path / "report.json")])
    assert code == 1
    assert f"{tmp_path / 'report.json'}: cannot be written: a file may not become so large" in capsys.readouterr().err
    assert tree(tmp_path) == before
