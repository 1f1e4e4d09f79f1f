"""Depth beside the disparity of a stereo camera: the unit is what z = focal * baseline / disparity says, or none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pcdata import open_source
from pcdata.errors import UnitError

FOCAL, BASELINE = 400.0, 0.05
DUMP = """Device info:
    Name                          : \tIntel RealSense D415

 Intrinsic of "Depth" / 64x48 / {{Z16}}
  Width:      \t64
  Height:     \t48
  PPX:        \t31.5
  PPY:        \t23.5
  Fx:         \t400
  Fy:         \t400
  Distortion: \tBrown Conrady
  Coeffs:     \t0  \t0  \t0  \t0  \t0
  FOV (deg):  \t9.1 x 6.9

Extrinsic from "Infrared 1"\t  To\t  "Infrared 2" :
 Rotation Matrix:
   1   0   0
   0   1   0
   0   0   1

 Translation Vector: {baseline}  0  0
"""


def stereo(folder: Path, unit: float, *, disparity: str = "whole", baseline: float = BASELINE) -> Path:
    """Write one frame of a slanted plane from 0.35 to 0.65 m, stored in a unit, with its disparity."""
    z = np.linspace(0.35, 0.65, 64 * 48).reshape(48, 64)
    shift = FOCAL * BASELINE / z
    Image.fromarray(np.rint(z / unit).astype(np.uint16)).save(folder / "0000_depth.png")
    if disparity == "float":
        np.save(folder / "0000_disparity.npy", shift.astype(np.float32))
    elif disparity == "parts":
        Image.fromarray(np.rint(shift * 32).astype(np.uint16)).save(folder / "0000_raw_disparity.png")
    else:
        Image.fromarray(np.floor(shift).astype(np.uint8)).save(folder / "0000_raw_disparity.png")
    (folder / "intrinsics.txt").write_text(DUMP.format(baseline=-baseline))
    return folder


@pytest.mark.parametrize("disparity", ["whole", "float"])
@pytest.mark.parametrize("unit", [0.001, 0.0001, 0.00025, 0.000125])
def test_disparity_and_baseline_tell_the_unit(tmp_path: Path, unit: float, disparity: str) -> None:
    frame = open_source(stereo(tmp_path, unit, disparity=disparity)).load("0000")
    assert float(frame.depth.max()) == pytest.approx(0.65, abs=0.001)
    assert frame.provenance["metres_per_unit"] == unit


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ({"disparity": "parts"}, "of 16 bits, which may be 1/16 or 1/32 of a pixel"),
        ({"baseline": BASELINE * 1.5}, "no usual unit is what it says"),
        ({"baseline": 0.0}, "no baseline"),
        ({"unit": 0.0254 / 10}, "tenths of an inch are no usual unit"),
    ],
)
def test_disparity_that_does_not_fit_one_unit_names_none(tmp_path: Path, said: dict[str, object], why: str) -> None:
    source = open_source(stereo(tmp_path, **{"unit": 0.001, **said}))  # type: ignore[arg-type]
    with pytest.raises(UnitError, match="no file states the unit of depth"):
        source.load("0000")


def test_disparity_of_another_scene_names_no_unit(tmp_path: Path) -> None:
    stereo(tmp_path, 0.001)
    other = np.random.default_rng(0).integers(20, 90, (48, 64)).astype(np.uint8)
    Image.fromarray(other).save(tmp_path / "0000_raw_disparity.png")
    with pytest.raises(UnitError, match="no file states the unit of depth"):
        open_source(tmp_path).load("0000")


def test_a_stated_unit_is_not_measured(tmp_path: Path) -> None:
    (stereo(tmp_path, 0.001) / "0000_raw_disparity.png").write_bytes(b"damaged")
    assert open_source(tmp_path, metres_per_unit=0.001).load("0000").depth.max() > 0.6
