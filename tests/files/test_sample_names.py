"""The order of sample names, and which names can be told apart."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pcdata.errors import CaptureError
from pcdata.files import sample_names
from pcdata.files.sample_names import check_names, in_order, in_order_of_last_number, name_some, positions


@pytest.mark.parametrize(
    "ordered",
    [
        [str(number) for number in range(120)],
        [f"frame_{number}_left" for number in range(12)],
        [f"scene{scene}_frame{frame}" for scene in (2, 10) for frame in (1, 9, 10)],
        ["2024-01-02T10", "2024-01-10T1", "2024-02-01T0"],
        ["1305031102.175304", "1305031102.2", "1305031102.211"],  # seconds with a fraction
        [f"1.{number}" for number in range(1, 12)],  # counted: 1.1 and 1.10 are not one number
        [f"{number:x}" for number in range(40)],
        [f"rgb_{number:04x}" for number in range(4000, 4400, 7)],
        ["2", "2b", "10"],  # one capture taken again, no hexadecimal count
        ["t_-10", "t_-9", "t_0", "t_3"],
        ["1", "9" * 300, "1" + "0" * 300],
        ["a", "b1", "b10"],
        ["frame-000840", "frame-000860", "frame-1000000"],
    ],
)
def test_names_stand_as_a_person_counts_whatever_order_they_come_in(ordered: list[str]) -> None:
    shuffled = list(ordered)
    random.Random(0).shuffle(shuffled)
    assert in_order(shuffled) == ordered
    check_names("here", ordered)


PADDED = st.tuples(
    st.sampled_from(["", "frame-", "t_-", "-", "a=-", "0a", "scene 1_", "2024-01-", "ü", "1."]),
    st.integers(1, 4),
    st.sampled_from(["", "-", "_-", ".", "a", "b0"]),
    st.sampled_from(["", ".color", "f", "-"]),
).flatmap(
    lambda parts: st.lists(
        st.builds(
            lambda one, two: f"{parts[0]}{one:0{parts[1]}}{parts[2]}{two}{parts[3]}",
            st.integers(0, 10 ** parts[1] - 1),
            st.integers(0, 9),
        ),
        min_size=1,
        max_size=8,
        unique=True,
    )
)


@given(PADDED)
def test_padded_names_which_are_not_split_stand_as_if_they_were(names: list[str]) -> None:
    """Names with digits at the same places are sorted as texts, since there may be hundreds of thousands of them."""
    fast = in_order(names), positions(names)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sample_names, "_stand_in_text_order", lambda names: False)
        assert fast == (in_order(names), positions(names))
        check_names("here", names)  # no two of one shape are one name


def test_a_position_is_the_number_at_the_end_only_where_names_are_alike_before_it() -> None:
    assert positions(["f1", "f10", "f2"]) == {"f1": 1, "f2": 2, "f10": 10}
    assert positions(["840", "0860"]) == {"840": 840, "0860": 860}
    assert positions(["mug", "bowl"]) == {"bowl": 0, "mug": 1}
    assert positions(["a2_f10", "a10_f1"]) == {"a2_f10": 0, "a10_f1": 1}
    assert positions(["3.75", "3.5"]) == {"3.5": 0, "3.75": 1}
    assert positions(["t_-3", "t_-5"]) == {"t_-5": 0, "t_-3": 1}
    assert positions(["9" * 40, "1"]) == {"1": 0, "9" * 40: 1}


@pytest.mark.parametrize("pair", [("1", "01"), ("f_7_left", "f_007_left"), ("caf\u00e9", "cafe\u0301"), ("-0", "0")])
def test_one_name_written_in_two_ways_is_an_error_that_names_both(pair: tuple[str, str]) -> None:
    with pytest.raises(CaptureError) as caught:
        check_names("here", ["5", *pair])
    assert all(repr(name) in str(caught.value) for name in pair)


def test_a_name_that_is_no_utf8_is_refused_and_shown_in_plain_letters() -> None:
    with pytest.raises(CaptureError, match=r"UTF-8 text, but b'a\\x80' is not") as caught:
        check_names("here", ["a\udc80", "b"])
    str(caught.value).encode("utf-8")


def test_cameras_stand_by_the_number_at_the_end_of_their_names() -> None:
    assert in_order_of_last_number(["left_10", "right_2", "up_1"]) == ["up_1", "right_2", "left_10"]
    assert in_order_of_last_number(["left", "cam10", "cam2"]) == ["cam2", "cam10", "left"]


def test_messages_name_the_first_in_order() -> None:
    assert name_some(str(number) for number in range(11, 0, -1)) == "1, 2, 3, 4, 5 and 6 more"
