"""Scores of object labels on cases counted by hand, and the files they are read from."""

from __future__ import annotations

import json
import math

import pytest
import torch

from pcdata.cli.main import main
from pcdata.errors import CaptureError, ConfigError, DTypeError, ShapeError
from pcdata.io import write_labels, write_pcd
from pcdata.structures import PointCloud
from pcdata.validation.label_files import matched_labels, paired_files, read_label_file
from pcdata.validation.segmentation import SCORES, mean_scores, score_segmentation


def image(rows: int, columns: int, **boxes: tuple[slice, slice]) -> torch.Tensor:
    """Draw boxes named _LABEL into an image without objects."""
    labels = torch.full((rows, columns), -1)
    for name, box in boxes.items():
        labels[box] = int(name[1:])
    return labels


def test_equal_labels_score_one_whatever_their_numbers():
    true = image(20, 30, _3=(slice(2, 8), slice(2, 8)), _9=(slice(10, 18), slice(5, 25)))
    scores = score_segmentation(torch.where(true >= 0, 12 - true, -7), true)
    assert [getattr(scores, name) for name in SCORES] == [1.0] * 8
    assert [(one.label, one.predicted) for one in scores.objects] == [(3, 9), (9, 3)]


def test_two_objects_in_one_prediction_share_its_precision():
    # 10 and 30 pixels, predicted as one of 40: it is assigned to the larger one, F = 2 * 30 / (30 + 40).
    true = torch.tensor([0] * 10 + [1] * 30 + [-1] * 10)
    scores = score_segmentation(torch.where(true >= 0, 5, -1), true)
    assert scores.overlap_precision == 30 / 40
    assert scores.overlap_recall == 30 / 40
    assert scores.found == 0.5
    assert [one.f for one in scores.objects] == [0.0, 60 / 70]
    assert [one.iou for one in scores.objects] == [10 / 40, 30 / 40]  # with the one that each shares most with
    assert scores.mean_iou == 0.5
    assert scores.boundary_f is None


def test_one_object_in_two_predictions_keeps_the_larger_part():
    true = torch.tensor([4] * 50 + [-1] * 50)
    guess = torch.tensor([0] * 40 + [1] * 15 + [-1] * 45)
    scores = score_segmentation(guess, true)
    assert scores.overlap_precision == 40 / 55
    assert scores.overlap_recall == 40 / 50
    assert scores.overlap_f == pytest.approx(2 * 40 / (55 + 50))
    assert scores.objects[0].predicted == 0


def test_the_assignment_maximizes_the_sum_and_not_the_first_choice():
    # F: true 0 with a .8, with b .6667; true 1 with a .75, with b 0: greedy takes (0, a) and leaves 1 without.
    true = torch.tensor([0] * 6 + [1] * 6 + [-1] * 8)
    guess = torch.full((20,), -1)
    guess[:3] = 1
    guess[3:6] = 0
    guess[6:10] = 0
    scores = score_segmentation(guess, true)
    assert [one.predicted for one in scores.objects] == [1, 0]
    assert [one.f for one in scores.objects] == pytest.approx([2 * 3 / 9, 2 * 4 / 13])


def test_a_boundary_is_matched_within_the_tolerance_alone():
    # Boxes of 20x20; the boundary of a mask has pixels on the left and upper side outside of it, on the others inside.
    true = image(100, 100, _0=(slice(30, 50), slice(30, 50)))
    moved = image(100, 100, _0=(slice(30, 50), slice(35, 55)))
    near = score_segmentation(moved, true, tolerance=5)
    assert near.boundary_f == 1.0
    far = score_segmentation(moved, true, tolerance=4)
    # Boundary: the ring of 21x21 pixels, 80 of them. Of the moved one the right column (21) is 5 pixels off, and of
    # the left column the 11 that are as far from the upper and lower side too.
    assert far.boundary_precision == far.boundary_recall == (80 - 21 - 11) / 80
    assert near.overlap_f == far.overlap_f == 0.75


def test_the_tolerance_is_a_part_of_the_diagonal_in_whole_pixels():
    true = image(480, 640, _0=(slice(100, 200), slice(100, 200)))
    for shift, matched in ((3, True), (4, False)):  # 0.003 * 800 = 2.4, rounded up
        moved = image(480, 640, _0=(slice(100, 200), slice(100 + shift, 200 + shift)))
        assert (score_segmentation(moved, true).boundary_f == 1.0) is matched


@pytest.mark.parametrize(
    ("tolerance", "error"),
    [
        *((number, ConfigError) for number in (0, 0.0, -0.003, math.nan, math.inf)),
        *((other, DTypeError) for other in ("0.003", True, None, [3])),
    ],
)
def test_a_tolerance_that_is_no_share_of_the_diagonal_and_no_pixels_is_refused(tolerance, error):
    true = image(10, 10, _0=(slice(0, 5), slice(0, 10)))
    with pytest.raises(error, match="score_segmentation: tolerance must be") as caught:
        score_segmentation(true, true, tolerance=tolerance)
    assert "points" not in str(caught.value), "it is no length of a cloud"
    assert score_segmentation(true, true, tolerance=1e-18).boundary_f == 1.0


def test_what_has_no_truth_is_not_scored():
    true = image(10, 10, _0=(slice(0, 5), slice(0, 10)))
    guess = image(10, 10, _0=(slice(0, 8), slice(0, 10)))
    blank = torch.zeros(10, 10, dtype=torch.bool)
    blank[5:8] = True
    assert score_segmentation(guess, true, ignore=blank).overlap_f == 1.0


@pytest.mark.parametrize(
    ("guess", "true", "precision", "recall", "f"),
    [([-1, -1], [-1, -1], 1, 1, 1), ([1, -1], [-1, -1], 0, 1, 0), ([-1, -1], [1, -1], 1, 0, 0)],
)
def test_scenes_without_objects_have_scores(guess, true, precision, recall, f):
    scores = score_segmentation(torch.tensor(guess), torch.tensor(true))
    assert (scores.overlap_precision, scores.overlap_recall, scores.overlap_f) == (precision, recall, f)


def test_the_mean_counts_every_image_the_same():
    true = torch.tensor([0] * 8 + [-1] * 8)
    whole, half = (score_segmentation(torch.where(torch.arange(16) < n, 0, -1), true) for n in (8, 4))
    means = mean_scores([whole, half])
    assert means["overlap_recall"] == 0.75
    assert means["boundary_f"] is None
    with pytest.raises(ConfigError, match="nothing to average"):
        mean_scores([])


def test_labels_that_cannot_be_compared_are_refused():
    labels = torch.zeros(4, 4, dtype=torch.int64)
    with pytest.raises(ShapeError, match="bring both to the same image"):
        score_segmentation(labels, labels[:2])
    with pytest.raises(DTypeError, match="tensor of integers, got"):
        score_segmentation(labels.float(), labels)
    with pytest.raises(DTypeError, match="bool"):
        score_segmentation(labels, labels, ignore=labels)
    with pytest.raises(ShapeError, match=r"\(H, W\) or rows"):
        score_segmentation(labels[None], labels[None])


@pytest.fixture
def folders(tmp_path):
    """Two folders of two label images each: scene2 is right, scene10 has two objects in one."""
    for folder in ("guess", "truth"):
        (tmp_path / folder).mkdir()
    true = image(24, 32, _1=(slice(2, 12), slice(2, 12)), _2=(slice(2, 12), slice(12, 20)))
    for scene, guess in (("scene2", true), ("scene10", torch.where(true >= 0, 1, -1))):
        write_labels(tmp_path / "truth" / f"{scene}.png", true, background_label=0)
        write_labels(tmp_path / "guess" / f"{scene}.png", guess, background_label=0)
    return tmp_path / "guess", tmp_path / "truth"


def test_the_command_scores_folders_by_name(folders, tmp_path, capsys):
    out = tmp_path / "scores.json"
    assert main(["evaluate", *map(str, folders), "--json", str(out)]) == 0
    told = capsys.readouterr().out.splitlines()
    assert [line.split()[:4] for line in told[2:5]] == [
        ["scene2", "2", "2", "1.000"],
        ["scene10", "2", "1", "0.556"],
        ["mean", "4", "3", "0.778"],
    ]
    assert told[5:6] == ["not found in scene10: 1 (0.71), 2 (0.00)"]
    assert json.loads(out.read_text())["mean"]["overlap_f"] == pytest.approx(7 / 9)


def test_a_scene_without_a_partner_is_named(folders, capsys):
    (folders[0] / "scene10.png").unlink()
    assert main(["evaluate", *map(str, folders)]) == 1
    assert "guess has no label file named scene10" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="one is a folder"):
        paired_files(folders[0], folders[1] / "scene2.png")
    with pytest.raises(CaptureError, match="does not exist"):
        paired_files(folders[0] / "no", folders[1])


def test_a_cloud_is_scored_against_an_organized_cloud_with_parts(tmp_path):
    points = torch.rand(12, 3) + 1
    cloud = PointCloud(points=points, frame_id="camera", labels=torch.tensor([1] * 4 + [20, 21, 20, 21] + [30] * 4))
    # The file is an image of 3x5 whose last three pixels have no reading.
    write_pcd(tmp_path / "true.pcd", cloud, encoding="ascii")
    text = (tmp_path / "true.pcd").read_text().replace("WIDTH 12", "WIDTH 5").replace("HEIGHT 1", "HEIGHT 3")
    text = text.replace("POINTS 12", "POINTS 15")
    (tmp_path / "true.pcd").write_text(text + "nan nan nan 0\n" * 3)
    write_pcd(tmp_path / "guess.pcd", cloud.with_fields(labels=torch.tensor([-1] * 4 + [0] * 4 + [1] * 4)))
    true = read_label_file(tmp_path / "true.pcd", parts=10, background=[0])
    guess = read_label_file(tmp_path / "guess.pcd")
    predicted, truth, blank = matched_labels(guess, true)
    assert truth.flatten()[:12].tolist() == [-1] * 4 + [2] * 4 + [3] * 4
    assert blank.flatten().tolist() == [False] * 12 + [True] * 3
    assert score_segmentation(predicted, truth, ignore=blank).overlap_f == 1.0
    short = read_label_file(tmp_path / "guess.pcd")
    with pytest.raises(ShapeError, match="in its order"):
        matched_labels(type(short)(short.path, short.labels[1:], short.place[1:], None), true)
    with pytest.raises(ConfigError, match="must end in"):
        read_label_file(tmp_path / "labels.txt")


def test_labels_of_any_size_score_alike():
    small = torch.randint(-2, 5, (2, 40, 60), generator=torch.Generator().manual_seed(0))
    large = torch.where(small >= 0, small * 10**12 + 7, -(10**9))
    few, many = (score_segmentation(*pair) for pair in (small, large))
    assert [many.overlap_f, many.boundary_f, many.mean_iou] == [few.overlap_f, few.boundary_f, few.mean_iou]
    assert [one.label for one in few.objects] == [0, 1, 2, 3, 4]
    assert [one.label for one in many.objects] == [k * 10**12 + 7 for k in range(5)]
