"""A build says where a step drops too much; with strict it fails before the dataset is in place."""

from __future__ import annotations

import pytest
import torch

from pcdata import PointCloud, build_dataset
from pcdata.build import config_from_yaml
from pcdata.errors import CaptureError
from pcdata.io.store.manifest import Manifest

CROP = "cloud: [CropWorkspace: {frame: base, lower: [0, 0, 0], upper: [1, 1, 1]}]\noutput: {format: npz}"


class Shares:
    """Clouds of 1,000 points, of which a share lies in the unit cube."""

    name = kind = "shares"

    def __init__(self, shares) -> None:
        self.shares = shares
        self.ids = [f"c{number}" for number in range(len(shares))]

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id):
        inside = round(1000 * self.shares[self.ids.index(sample_id)])
        points = torch.full((1000, 3), 5.0)
        points[:inside] = 0.5
        return PointCloud(points=points, ptr=torch.tensor([0, 1000]), frame_id="base")


def test_a_build_names_the_capture_that_is_an_outlier_and_strict_fails(tmp_path):
    source, config = Shares([0.9] * 8 + [0.1]), config_from_yaml(CROP)
    said: list[str] = []
    report = build_dataset(config, source, tmp_path / "set", note=said.append)
    (told,) = [note for note in report.notes if "CropWorkspace" in note]
    assert "1 of 9 captures are outliers of the rest: 'c8' keeps 100; the median keeps 900" in told
    assert told in said
    manifest = Manifest.read(tmp_path / "set")
    assert [one["name"] for one in manifest.alarms] == ["CropWorkspace"]
    assert manifest.steps == (
        {
            "step": "CropWorkspace",
            "samples": 9,
            "before": None,
            "min": 100,
            "p5": 100,
            "median": 900,
            "p95": 900,
            "max": 900,
        },
    )
    with pytest.raises(CaptureError, match="steps drop more than is usual"):
        build_dataset(config, source, tmp_path / "strict", strict=True)
    assert not (tmp_path / "strict").exists()
    build_dataset(config, source, tmp_path / "strict")  # the way out: it goes on from what is kept
    assert len(Manifest.read(tmp_path / "strict").samples) == 9


def test_a_build_without_alarm_says_nothing_and_passes_strict(tmp_path):
    report = build_dataset(config_from_yaml(CROP), Shares([0.9] * 9), tmp_path / "set", strict=True)
    assert report.notes == []
    assert Manifest.read(tmp_path / "set").alarms == ()
