"""The depth file as it is stored, before a reader cleans or refuses it."""

from __future__ import annotations

from pathlib import Path

from pcdata.io.raw_faults import RawFaults, count_raw_faults
from pcdata.validation.check import Check, Verdict


def raw_value_check(path: Path) -> Check:
    """Judge the stored values: NaN and infinity warn, because programs differ on them; negative depth fails.

    Raises:
        CaptureError: the file is missing, damaged, or not a depth image.
    """
    faults = count_raw_faults(path)
    if faults is None:
        return Check(
            name="raw_values",
            verdict=Verdict.PASS,
            found="whole numbers: none can be NaN, infinite or negative",
            value=0.0,
            threshold=0.0,
        )
    return _judged(faults)


def _judged(faults: RawFaults) -> Check:
    bad = faults.nan + faults.infinite + faults.negative
    verdict = Verdict.FAIL if faults.negative else Verdict.WARN if bad else Verdict.PASS
    advice = {
        Verdict.PASS: "",
        Verdict.WARN: "pcdata reads them as 0, no reading; store 0 so that every program does",
        Verdict.FAIL: "is z pointing backwards (OpenGL axes)? Flip the sign when exporting, write 0 for 'no reading'",
    }[verdict]
    return Check(
        name="raw_values",
        verdict=verdict,
        found=f"of {faults.num_pixels:,} values {faults.nan:,} are NaN, {faults.infinite:,} infinite, "
        f"{faults.negative:,} negative",
        value=bad / faults.num_pixels,
        threshold=0.0,
        advice=advice,
    )
