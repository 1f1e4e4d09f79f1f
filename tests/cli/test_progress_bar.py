"""Progress without a terminal: seconds, the rate, and how long the rest takes."""

from __future__ import annotations

import re

import pytest

from pcdata.cli import progress_bar
from pcdata.cli.progress_bar import ProgressBar


@pytest.fixture
def clock(monkeypatch):
    """A clock that a test sets, and lines as often as they are told."""
    now = [100.0]
    monkeypatch.setattr(progress_bar, "_SELDOM", 0.0)
    monkeypatch.setattr(progress_bar.time, "perf_counter", lambda: now[0])
    return now


def test_the_time_left_does_not_count_how_long_workers_took_to_start(clock, capsys):
    with ProgressBar("build") as progress:
        for done, seconds in ((1, 9.0), (2, 9.1), (51, 14.0), (100, 19.0)):
            clock[0] = 100.0 + seconds
            progress(done, 100, f"c{done}")
    assert capsys.readouterr().err.splitlines() == [
        "build 1/100 c1 9.0 s",
        "build 2/100 c2 9.1 s, 10/s, 10 s left",
        "build 51/100 c51 14.0 s, 10/s, 5 s left",
        "build 100/100 c100 19.0 s, 5.26/s",
    ]


def test_what_was_done_before_is_in_no_rate(clock, capsys):
    with ProgressBar("build") as progress:
        for done, seconds in ((91, 1.0), (96, 6.0), (100, 10.0)):
            clock[0] = 100.0 + seconds
            progress(done, 100, "c")
    told = capsys.readouterr().err
    assert "96/100 c 6.0 s, 1/s, 4 s left" in told
    assert re.search(r"100/100 c 10\.0 s, 1/s$", told)


def test_a_work_that_tells_of_its_beginning_is_measured_from_there(clock, capsys):
    with ProgressBar("compare") as progress:
        clock[0] = 160.0
        progress(0, 4, "")
        clock[0] = 162.0
        progress(2, 4, "a")
        clock[0] = 164.0
        progress(4, 4, "b")
    assert capsys.readouterr().err.splitlines() == [
        "compare 0/4",
        "compare 2/4 a 2.0 s, 1/s, 2 s left",
        "compare 4/4 b 4.0 s, 1/s",
    ]
