"""The depth file as it is stored, before a reader cleans or refuses it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from pcdata.io.images.stored_faults import RawFaults, count_raw_faults
from pcdata.validation.capture_check import Check, Explained
from pcdata.verdicts import Finding, Verdict


class RawValues(Check):
    """NaN and infinity warn, as programs differ on them; negative depth fails."""

    question = "Which stored values are no depth, before a reader cleans them?"
    findings: ClassVar = {
        "raw_values": Explained(
            "share of stored values that are NaN, infinite or negative, before the reader cleans them",
            "0",
            "any negative",
            "NaN and infinity only warn: readers differ on them. 16-bit images cannot hold any",
        )
    }

    def files(self, depth: Sequence[Path]) -> list[Finding]:
        """Judge every file.

        Raises:
            CaptureError: a file is missing, damaged, or not a depth image.
        """
        if len(depth) == 1:
            return [_judged_file(depth[0])]
        return [replace(_judged_file(path), view=view) for view, path in enumerate(depth)]


def _judged_file(path: Path) -> Finding:
    faults = count_raw_faults(path)
    if faults is None:
        return Finding(
            name="raw_values",
            verdict=Verdict.PASS,
            found="whole numbers: none can be NaN, infinite or negative",
            value=0.0,
            threshold=0.0,
        )
    return _judged(faults)


def _judged(faults: RawFaults) -> Finding:
    bad = faults.nan + faults.infinite + faults.negative
    verdict = Verdict.FAIL if faults.negative else Verdict.WARN if bad else Verdict.PASS
    advice = {
        Verdict.PASS: "",
        Verdict.WARN: "pcdata reads them as 0, no reading; store 0 so that every program does",
        Verdict.FAIL: "is z pointing backwards (OpenGL axes)? Flip the sign when exporting, write 0 for 'no reading'",
    }[verdict]
    return Finding(
        name="raw_values",
        verdict=verdict,
        found=f"of {faults.num_pixels:,} values {faults.nan:,} are NaN, {faults.infinite:,} infinite, "
        f"{faults.negative:,} negative",
        value=bad / faults.num_pixels,
        threshold=0.0,
        advice=advice,
    )
