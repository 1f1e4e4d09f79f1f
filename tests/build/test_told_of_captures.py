"""What steps say of captures reaches whoever builds: warnings of workers in one line, a wrong unit with the refusal."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from pcdata import build_dataset, open_source
from pcdata.build import config_from_yaml
from pcdata.cli.main import main
from pcdata.errors import TooFewPointsError
from pcdata.io import write_depth
from pcdata.transforms.families import LeftOutWarning

_CONFIG = """
depth: [{near}Deproject]
cloud:
  - ClusterObjects: {{eps: 0.05, min_points: 10, max_size: 3000, keep: all}}
"""


@pytest.fixture
def captures(tmp_path: Path) -> Path:
    """Seven walls at 1 m, each one large cluster."""
    folder = tmp_path / "captures"
    (folder / "depth").mkdir(parents=True)
    stated = {"width": 80, "height": 60, "fx": 80, "fy": 80, "cx": 39.5, "cy": 29.5, "metres_per_unit": 0.001}
    (folder / "intrinsics.json").write_text(json.dumps(stated))
    for number in range(7):
        write_depth(folder / "depth" / f"{number}.png", torch.full((60, 80), 1.0), metres_per_unit=0.001)
    (tmp_path / "build.yaml").write_text(_CONFIG.format(near=""))
    return folder


@pytest.mark.filterwarnings("default::pcdata.errors.PcdataWarning")
def test_warnings_of_workers_are_shown_as_those_of_this_process(
    captures: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    told = []
    for workers in ("0", "2"):
        words = ["build", str(tmp_path / "build.yaml"), "--source", str(captures), "--workers", workers]
        assert main([*words, "--out", str(tmp_path / workers)]) == 0
        lines = [line for line in capfd.readouterr().err.splitlines() if "arning" in line]
        assert len(lines) == 6
        assert lines[-1] == "pcdata: warning: 2 more of the kind LeftOutWarning"
        told.append({line.partition(" (sample")[0] for line in lines})
    assert told[0] == told[1]


@pytest.mark.filterwarnings("default::pcdata.errors.PcdataWarning")
def test_in_python_the_warnings_of_workers_are_warnings(captures: Path, tmp_path: Path) -> None:
    config = config_from_yaml(_CONFIG.format(near=""), name="build")
    with pytest.warns(LeftOutWarning, match="sample '3'"):
        build_dataset(config, open_source(captures), tmp_path / "set", workers=1)


@pytest.mark.parametrize("workers", [0, 1])
def test_a_refused_capture_of_a_wrong_unit_says_so(captures: Path, tmp_path: Path, workers: int) -> None:
    stated = json.loads((captures / "intrinsics.json").read_text())
    (captures / "intrinsics.json").write_text(json.dumps(stated | {"metres_per_unit": 0.01}))
    config = config_from_yaml(_CONFIG.format(near="MaskDepth: {near: 0.2, far: 2.0}, "), name="build")
    with pytest.raises(
        TooFewPointsError, match=r"no points: .*; the unit of depth looks wrong: .* within 10 m;.* 0.001"
    ):
        build_dataset(config, open_source(captures), tmp_path / "set", workers=workers)
