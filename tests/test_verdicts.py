"""One form for every judgment: verdicts in order, numbers with their limits, tables of limits that hold together."""

from __future__ import annotations

import json
import math
from dataclasses import fields

import pytest

from pcdata.calibration import CalibrationLimits
from pcdata.errors import ConfigError
from pcdata.validation import CaptureLimits, DriftLimits, OverlapLimits
from pcdata.verdicts import Finding, Limits, Verdict, at_least, at_most, graded, in_figures, judged, worst

TABLES = (CaptureLimits, OverlapLimits, CalibrationLimits, DriftLimits)


def test_unknown_is_worse_than_a_pass_and_better_than_a_warning():
    ranked = sorted(Verdict, key=lambda verdict: verdict.severity)
    assert [str(verdict) for verdict in ranked] == ["pass", "unknown", "warn", "fail"]
    assert worst([Verdict.UNKNOWN, Verdict.PASS]) is Verdict.UNKNOWN
    assert worst([Verdict.UNKNOWN, Verdict.FAIL, Verdict.WARN]) is Verdict.FAIL
    assert worst([]) is Verdict.PASS


@pytest.mark.parametrize(
    ("value", "verdict"),
    [(1.0, Verdict.PASS), (2.0, Verdict.PASS), (3.0, Verdict.WARN), (3.01, Verdict.FAIL), (math.nan, Verdict.FAIL)],
)
def test_a_limit_is_the_last_value_on_its_side_in_both_directions(value, verdict):
    assert judged(value, 2.0, 3.0) is verdict
    assert judged(-value, -2.0, -3.0, at_least=True) is verdict


def test_a_number_without_a_second_limit_never_fails():
    assert judged(9.0, 2.0, None) is Verdict.WARN
    assert judged(math.nan, 2.0, None) is Verdict.WARN


def test_advice_is_told_only_where_something_is_to_be_done():
    for value, advice in ((1.0, ""), (5.0, "mend it")):
        assert graded("x", value, (2.0, 3.0), found="", advice="mend it").advice == advice


def test_numbers_in_words_show_on_which_side_of_the_limit_they_lie():
    finding = at_most("shift", 0.0030001, 0.003, "look again", unit="m", shown=("mm", 1000.0))
    assert (finding.verdict, finding.found) == (Verdict.FAIL, "3.0001 mm, at most 3 mm")
    assert at_least("fill", 0.99, 0.99, "", shown=("%", 100.0)).found == "99 %, at least 99 %"


def test_a_finding_is_plain_json():
    plain = json.loads(json.dumps(Finding(name="x", verdict=Verdict.WARN, value=math.inf).to_json(), allow_nan=False))
    assert plain["verdict"] == "warn"
    assert plain["value"] is None


def test_every_table_of_limits_is_one_of_these():
    assert set(TABLES) == set(Limits.__subclasses__())


@pytest.mark.parametrize("table", TABLES)
def test_limits_that_cannot_hold_are_refused_by_name(table):
    """For every field of every table: not a number, without bound, negative, a pair the wrong way round."""
    for field in fields(table):
        pair = isinstance(field.default, tuple)
        if pair and len(field.default) == 2:
            bad = [(math.nan, math.nan), (-1.0, 1.0), field.default[::-1], field.default[:1], 0.5]
        else:
            bad = [(bad,) if pair else bad for bad in (math.nan, math.inf, -0.5, "much")]
        for value in bad:
            with pytest.raises(ConfigError, match=rf"{table.__name__}: {field.name}"):
                table(**{field.name: value})


@pytest.mark.parametrize(
    ("value", "told"),
    [
        *((280_900.0, "280,900"), (1000.0, "1,000"), (999.94, "999.9"), (-4_500_000.2, "-4,500,000"), (0.0, "0")),
        *((0.000123456, "0.0001235"), (0.00002, "0.00002"), (1.0, "1"), (math.nan, "nan"), (math.inf, "inf")),
    ],
)
def test_numbers_are_written_as_they_are_read(value, told):
    assert in_figures(value) == told
