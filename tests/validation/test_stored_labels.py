"""Scores of what a build stored: its points are brought back to their pixels, and what would mislead is refused."""

from __future__ import annotations

import json
import shutil

import pytest
import torch

from pcdata.build import build_dataset, config_from_yaml
from pcdata.cli.main import main
from pcdata.io import write_depth, write_labels, write_pcd
from pcdata.report.segmentation_text import segmentation_text
from pcdata.structures import PointCloud
from pcdata.validation.label_files import matched_labels, read_label_file
from pcdata.validation.segmentation import score_segmentation

_STEPS = """
depth: [Deproject]
cloud:
  - RemovePlane: {distance: 0.01}
  - ClusterObjects: {min_size: 100}
"""


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Two captures of two boxes on a table, and their true labels: 0 = none, 4 and 9."""
    root = tmp_path_factory.mktemp("scenes")
    (root / "truth").mkdir()
    (root / "captures" / "depth").mkdir(parents=True)
    stated = {"width": 160, "height": 120, "fx": 300, "fy": 300, "cx": 79.5, "cy": 59.5, "metres_per_unit": 0.001}
    (root / "captures" / "intrinsics.json").write_text(json.dumps(stated))
    for number in range(2):
        depth, truth = torch.full((120, 160), 0.9), torch.full((120, 160), -1)
        for label, rows, columns in ((4, slice(20, 60), slice(30, 70)), (9, slice(70, 110), slice(90 + number, 130))):
            depth[rows, columns] -= 0.1
            truth[rows, columns] = label
        write_depth(root / "captures" / "depth" / f"{number:04d}.png", depth, metres_per_unit=0.001)
        write_labels(root / "truth" / f"{number:04d}.png", truth, background_label=0)
    return root


def _built(scenes, name, more=""):
    from pcdata import open_source

    folder = scenes / name
    if not folder.exists():
        build_dataset(config_from_yaml(_STEPS + more, name=name), open_source(scenes / "captures"), folder)
    return folder


def test_a_dataset_is_scored_at_the_pixels_of_the_truth(scenes, capsys):
    assert main(["evaluate", str(_built(scenes, "whole")), str(scenes / "truth")]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[2:]]
    assert [row[0] for row in rows] == ["0000", "0001", "mean"]
    assert all(row[1:] == [row[1], row[1], *["1.000"] * 8] for row in rows)


@pytest.mark.parametrize("step", ["SplitObjects", "EstimateNormals: {radius: 0.02, max_neighbors: 10}"])
def test_steps_that_leave_every_point_change_no_score(scenes, capsys, step):
    folder = _built(scenes, step.partition(":")[0], f"  - {step}\n")
    assert main(["evaluate", str(folder), str(scenes / "truth")]) == 0
    assert capsys.readouterr().out.splitlines()[-1].split()[3:] == ["1.000"] * 8


@pytest.mark.parametrize(
    ("step", "said"),
    [
        ("FarthestPointSample: {num_points: 500}", "has 500 of the 3200 points of its objects"),
        ("VoxelDownsample: {voxel_size: 0.01}", "points of its objects|does not know its pixels"),
    ],
)
def test_points_that_were_left_out_are_no_missed_objects(scenes, capsys, step, said):
    folder = _built(scenes, step.partition(":")[0], f"  - {step}\n")
    assert main(["evaluate", str(folder), str(scenes / "truth")]) == 1
    told = capsys.readouterr().err
    assert any(one in told for one in said.split("|")), told


def test_truth_of_another_image_is_refused(scenes, tmp_path, capsys):
    for number in range(2):
        write_labels(tmp_path / f"{number:04d}.png", torch.full((240, 320), -1), background_label=0)
    assert main(["evaluate", str(_built(scenes, "whole")), str(tmp_path)]) == 1
    assert "is of an image of 160x120 but" in capsys.readouterr().err


def test_every_sample_needs_its_truth(scenes, tmp_path, capsys):
    shutil.copy(scenes / "truth" / "0000.png", tmp_path)
    folder = str(_built(scenes, "whole"))
    assert main(["evaluate", folder, str(tmp_path)]) == 1
    assert "has no label file named 0001" in capsys.readouterr().err
    for name in ("0001", "other"):
        shutil.copy(scenes / "truth" / "0001.png", tmp_path / f"{name}.png")
    assert main(["evaluate", folder, str(tmp_path)]) == 1
    assert "has no sample named other" in capsys.readouterr().err
    assert main(["evaluate", folder, str(tmp_path / "0000.png")]) == 1
    assert "has 2 samples" in capsys.readouterr().err
    assert main(["evaluate", str(tmp_path), folder]) == 2
    assert "is a dataset, which may be PREDICTED alone" in capsys.readouterr().err
    assert main(["evaluate", folder, str(scenes / "truth"), "--background", "0"]) == 2
    assert "--background is for files" in capsys.readouterr().err


def test_what_is_ignored_counts_for_neither(scenes, capsys):
    assert main(["evaluate", str(_built(scenes, "whole")), str(scenes / "truth"), "--ignore", "9"]) == 0
    last = capsys.readouterr().out.splitlines()[-1].split()
    assert last[1:] == ["2", "2", *["1.000"] * 8]
    rows = read_label_file(scenes / "truth" / "0000.png", ignore=[9, 0])
    _, truth, blank = matched_labels(rows, rows)
    assert blank is not None
    assert blank.tolist() == (truth != 4).tolist()
    cloud = PointCloud(points=torch.rand(4, 3), frame_id="camera", labels=torch.tensor([0, 0, 1, 7]))
    write_pcd(scenes / "cloud.pcd", cloud)
    rows = read_label_file(scenes / "cloud.pcd", ignore=[7])
    _, _, blank = matched_labels(rows, rows)
    assert blank is not None
    assert blank.tolist() == [False, False, False, True]


def test_scores_of_nothing_and_of_depth_images_say_so():
    nothing = torch.full((40, 60), -1)
    text = segmentation_text({"a": score_segmentation(nothing, nothing)})
    assert "no scene has a true object" in text
    many = torch.arange(2400).reshape(40, 60)
    text = segmentation_text({"a": score_segmentation(nothing, many)})
    assert "a has 2,400 true objects: is this an image of depth" in text
    assert "9 (0.00) and 2390 more" in text
    assert len(text) < 1000
