"""Numbers in messages show on which side of their limit they lie."""

from __future__ import annotations

import math

from pcdata.errors import told_apart


def test_a_number_just_beyond_its_limit_is_told_from_it() -> None:
    assert told_apart(0.1004, 0.1) == ("0.1004", "0.1")
    assert told_apart(0.10000004, 0.1) == ("0.10000004", "0.1")
    assert told_apart(5.0, 5.0) == ("5", "5")
    assert told_apart(12.3456, 3.0) == ("12.3", "3")


def test_what_is_no_number_is_shown_as_such() -> None:
    assert told_apart(math.nan, 1.0) == ("nan", "1")
    assert told_apart(math.inf, 1.0) == ("inf", "1")
