"""Every unit declared as every other one: the true one is named, and no advice leads to a pass at a wrong scale."""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from pcdata.functional.depth.unit_fit import DepthUnit, encoded, unit_fits
from pcdata.io import open_source
from pcdata.structures import Camera, DepthFrame
from pcdata.synthetic import look_at, tabletop
from pcdata.validation import CaptureLimits, validate_source
from pcdata.validation.checks.depth_unit import depth_unit_check
from pcdata.verdicts import Finding, Verdict

UNITS = [
    *map(DepthUnit, (0.001, 0.00025, 0.0002, 0.0001, 1 / 256)),
    DepthUnit(0.001, "rotated"),
    DepthUnit(1.0),
]
FOCAL = 300.0
OPTION = re.compile(
    r"(?:metres_per_unit=|--metres-per-unit )([0-9.e-]+)(?:(?:, depth_encoding=| --depth-encoding )(\w+))?"
)


@cache
def table(seed: int, noise: str | None = "stereo") -> np.ndarray:
    """(240, 320) metres."""
    return tabletop(seed, noise=noise, size=(240, 320)).frame.depth[0].numpy().astype(np.float64)


@cache
def room(seed: int) -> np.ndarray:
    """(240, 320) metres, 2 to 6: the floor with a table on it, from where somebody stands."""
    pose = look_at((2.4, -1.5 + 0.2 * seed, 1.6))[None]
    return tabletop(seed, noise="stereo", size=(240, 320), world_from_camera=pose).frame.depth[0].numpy().astype(float)


def capture(folder: Path, metres: np.ndarray, unit: DepthUnit) -> Path:
    """Store depth in a unit."""
    from PIL import Image

    (folder / "depth").mkdir(parents=True)
    if unit.metres == 1.0:
        np.save(folder / "depth" / "0.npy", metres.astype(np.float32))
    else:
        stored = np.rint(metres / unit.metres)
        stored[stored > 65535] = 0
        Image.fromarray(encoded(stored.astype(np.uint16), unit.encoding)).save(folder / "depth" / "0.png")
    height, width = metres.shape
    facts = {"width": width, "height": height, "fx": FOCAL, "fy": FOCAL, "cx": (width - 1) / 2, "cy": (height - 1) / 2}
    (folder / "intrinsics.json").write_text(json.dumps(facts))
    return folder


@cache
def judged(folder: Path, unit: DepthUnit, limits: CaptureLimits | None = None) -> tuple[Verdict, str, float]:
    """The verdict on a declared unit, all that is said, and the median in metres."""
    from pcdata.errors import UnitError

    try:
        frame = open_source(folder, metres_per_unit=unit.metres, depth_encoding=unit.encoding).load("0")
    except UnitError as error:
        return Verdict.FAIL, str(error), float("nan")
    check: Finding = depth_unit_check(frame.depth[0], limits or CaptureLimits(), frame.provenance, focal=FOCAL)
    return check.verdict, f"{check.found}; {check.advice}", check.value or 0.0


def named(text: str) -> set[DepthUnit]:
    return {DepthUnit(float(metres), order or "plain") for metres, order in OPTION.findall(text)}  # type: ignore[arg-type]


@pytest.mark.parametrize("scene", ["table", "quiet table", "room"])
@pytest.mark.parametrize("true", UNITS, ids=str)
def test_the_true_unit_is_named_and_no_advice_passes_at_a_wrong_scale(
    tmp_path: Path, true: DepthUnit, scene: str
) -> None:
    metres = {"table": table(21), "quiet table": table(22, None), "room": room(23)}[scene]
    median = float(np.median(metres[metres > 0]))
    folder = capture(tmp_path / "c", metres, true)
    for declared in UNITS:
        if true.metres == 1.0 and declared.encoding != "plain":
            continue  # floats have no order of bits: refused with the reason
        verdict, text, found = judged(folder, declared)
        is_right = found == pytest.approx(median, rel=0.02)
        if verdict is Verdict.PASS:
            assert is_right, f"{declared} passes at {found} m; it is {median} m: {text}"
        elif not is_right:
            assert any(unit == true for unit in named(text)), f"declared {declared}: {text}"
        for advised in named(text):
            follows, _, leads_to = judged(folder, advised)
            assert follows is not Verdict.PASS or leads_to == pytest.approx(median, rel=0.02), f"{advised} passes"


@pytest.mark.parametrize("seed", [31, 32])
@pytest.mark.parametrize("unit", [DepthUnit(0.001), DepthUnit(1.0)], ids=str)
def test_millimetres_and_metres_that_are_right_pass(tmp_path: Path, unit: DepthUnit, seed: int) -> None:
    stated = CaptureLimits(workspace=(0.3, 6.0))
    scenes = [(table(seed), None), (table(seed, None), None), (room(seed % 5), stated), (room(seed % 5), None)]
    for number, (scene, limits) in enumerate(scenes):
        verdict, text, _ = judged(capture(tmp_path / str(number), scene, unit), unit, limits)
        assert verdict is Verdict.PASS, text


def test_a_sensor_or_a_measured_workspace_tells_units_apart_that_fit_alike(tmp_path: Path) -> None:
    true = DepthUnit(1 / 256)
    folder = capture(tmp_path / "c", table(24), true)
    assert judged(folder, true)[0] is Verdict.WARN
    assert judged(folder, true, CaptureLimits(workspace=(0.5, 1.5)))[0] is Verdict.PASS
    assert judged(folder, DepthUnit(0.001), CaptureLimits(workspace=(0.5, 1.5)))[0] is not Verdict.PASS
    fine = capture(tmp_path / "d", table(24), DepthUnit(0.0001))
    assert judged(fine, DepthUnit(0.0001), CaptureLimits.for_sensor("realsense_d415"))[0] is Verdict.PASS


def test_depth_made_in_memory_is_told_the_factor() -> None:
    camera = Camera.pinhole(fx=FOCAL, fy=FOCAL, cx=160, cy=120, size=(240, 320))
    depth = torch.from_numpy(table(25)).float()
    for factor, cure in ((5.0, "0.2"), (4.0, "0.25"), (0.2, "5"), (10.0, "0.1")):
        frame = DepthFrame(depth=(factor * depth)[None], camera=camera)
        check = depth_unit_check(frame.depth[0], CaptureLimits(), frame.provenance, focal=FOCAL)
        assert check.verdict is not Verdict.PASS
        assert f"multiply depth by {cure} (" in check.advice or f"or {cure} (" in check.advice


def test_numbers_without_a_reading_fit_no_unit() -> None:
    assert unit_fits(np.zeros((20, 20), np.uint16)) == []


@pytest.mark.parametrize("seed", [0, 2])
def test_depth_in_tenths_of_a_millimeter_read_as_millimeters_never_passes_and_is_named(
    tmp_path: Path, seed: int
) -> None:
    path = capture(tmp_path, table(seed), DepthUnit(0.0001))
    facts = json.loads((path / "intrinsics.json").read_text()) | {"metres_per_unit": 0.001}
    (path / "intrinsics.json").write_text(json.dumps(facts))
    (report,) = (one for one in validate_source(open_source(path)) if not one.whole)
    (finding,) = (one for one in report.findings if one.name == "depth_unit")
    assert finding.verdict in (Verdict.WARN, Verdict.FAIL)
    assert report.verdict is finding.verdict
    assert "--metres-per-unit 0.0001" in finding.advice
