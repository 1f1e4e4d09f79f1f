"""The grade of a recording follows its rule, and its reasons say which camera, since when, in which episodes."""

from __future__ import annotations

import json

import pytest

from pcdata.structures import Episode
from pcdata.validation import WHOLE, SampleReport
from pcdata.validation.grading import Grading
from pcdata.verdicts import Finding, Verdict

IDS = [f"c{place:02}" for place in range(20)]


def graded(verdicts: dict[int, Verdict], *, view: int = 1, whole: Verdict | None = None, **options) -> Grading:
    names = options.pop("names", ())
    grading = Grading(IDS, **options)
    for place, sample_id in enumerate(IDS):
        verdict = verdicts.get(place, Verdict.PASS)
        found = Finding(
            name="noise", verdict=verdict, found=f"{place} mm", value=float(place), view=view, advice="mend"
        )
        grading.add(SampleReport(sample_id, (found, Finding(name="other")), views=tuple(names)))
    if whole is not None:
        grading.add(SampleReport(WHOLE, (Finding(name="poses", verdict=whole, found="mixed"),), whole=True))
    return grading


@pytest.mark.parametrize(
    ("verdicts", "whole", "letter"),
    [
        ({}, None, "A"),
        ({3: Verdict.UNKNOWN}, Verdict.PASS, "A"),
        ({3: Verdict.WARN, 4: Verdict.WARN}, None, "B"),
        ({3: Verdict.WARN, 4: Verdict.WARN, 5: Verdict.WARN}, None, "C"),
        ({}, Verdict.WARN, "C"),
        ({3: Verdict.FAIL}, None, "D"),
        ({3: Verdict.FAIL, 4: Verdict.FAIL, 5: Verdict.FAIL}, None, "F"),
        ({}, Verdict.FAIL, "F"),
    ],
)
def test_the_letter_follows_from_shares(verdicts, whole, letter):
    assert graded(verdicts, whole=whole).grade().letter == letter


def test_none_that_could_be_read_is_an_f():
    assert Grading(IDS).grade().letter == "F"
    assert Grading(IDS).grade().reasons == ("no capture could be read",)


def test_a_reason_says_since_when_and_which_camera():
    late = graded(dict.fromkeys(range(12, 20), Verdict.FAIL), names=["view 0 (left)", "view 1 (right)"])
    (reason,) = late.grade().reasons
    assert reason == "fail noise view 1 (right), in 8 of 20 captures, from 'c12' on: 12 mm; mend"
    (once,) = graded({4: Verdict.WARN, 9: Verdict.WARN}).grade().reasons
    assert once == "warn noise view 1, in 2 of 20 captures, first 'c04': 4 mm; mend"
    (always,) = graded(dict.fromkeys(range(20), Verdict.WARN)).grade().reasons
    assert "in all 20 captures" in always


def test_a_reason_names_the_episodes():
    episodes = [Episode(id=name, first=first, length=10) for name, first in (("morning", 0), ("noon", 10))]
    grading = graded({12: Verdict.FAIL, 13: Verdict.FAIL}, episodes=episodes)
    assert "episodes noon (2)" in grading.grade().reasons[0]
    told = grading.to_json()["episodes"]
    assert [one["captures"]["fail"] for one in told] == [0, 2]


def test_failures_come_before_warnings():
    grading = Grading(IDS[:1])
    findings = [Finding(name=name, verdict=verdict) for name, verdict in (("w", Verdict.WARN), ("f", Verdict.FAIL))]
    grading.add(SampleReport(IDS[0], tuple(findings)))
    assert [reason.split()[0] for reason in grading.grade().reasons] == ["fail", "warn"]


def test_the_json_holds_every_check_and_is_plain():
    told = json.loads(json.dumps(graded({3: Verdict.WARN}, whole=Verdict.PASS).to_json(), allow_nan=False))
    assert told["schema"] == "pcdata.grade/1"
    noise = next(check for check in told["checks"] if check["name"] == "noise")
    assert noise["values"] == {"min": 0.0, "median": 9.5, "max": 19.0}
    assert (noise["first"], noise["ever_since"], noise["counts"]) == ("c03", False, {"pass": 19, "warn": 1})
