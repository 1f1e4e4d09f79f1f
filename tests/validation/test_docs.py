"""The limits told in docs/multi_view.md are those of the code."""

import inspect
from pathlib import Path

from pcdata.calibration import refine_extrinsics
from pcdata.validation import OverlapLimits

TEXT = " ".join((Path(__file__).parents[2] / "docs" / "multi_view.md").read_text(encoding="utf-8").split())


def test_the_limits_told_are_those_of_the_code():
    limits = OverlapLimits()
    for name, (passes, fails) in (("gap of a pair", limits.residual), ("shift of a camera", limits.shift)):
        assert f"{name} | up to {1e3 * passes:g} mm | up to {1e3 * fails:g} mm" in TEXT
    passes, fails = limits.rotation_degrees
    assert f"up to {passes:g} degrees | up to {fails:g} degrees" in TEXT
    assert f"up to {1e3 * limits.max_shift_sigma:g} mm, {limits.max_rotation_sigma_degrees:g} degrees" in TEXT
    defaults = inspect.signature(refine_extrinsics).parameters
    told = f"more than {1e3 * defaults['max_shift'].default:g} mm, or turn by more than"
    assert f"{told} {defaults['max_rotation_degrees'].default:g} degrees" in TEXT
