"""The option ``signals``: what streams are, by name, the same at every reader."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from pcdata.errors import CaptureError, ConfigError, FrameError
from pcdata.io.sources.stated_kinds import check_stated_names, kind_of, signal_of, stated_kinds

POSE = ("pose xyz_quat_xyzw", "base")


def test_what_is_stated_goes_before_what_a_format_says_and_nothing_said_is_invariant() -> None:
    stated = stated_kinds("test", {"eef": {"kind": POSE[0], "frame": "base"}, "debug": None})
    assert kind_of("eef", stated, ("position", "world")) == POSE
    assert kind_of("debug", stated, None) is None
    assert kind_of("tip", stated, ("position", "world")) == ("position", "world")
    assert kind_of("joints", stated, None) == ("invariant", None)
    assert stated_kinds("test", None) == {}


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        (["eef"], ConfigError, "must be a mapping of names"),
        ({"eef": "pose matrix"}, ConfigError, "must be None to leave it out, or an object with kind"),
        ({"eef": {"frame": "base"}}, ConfigError, "an object with kind"),
        ({"eef": {"kind": "pose matrix", "frame": "base", "unit": "m"}}, ConfigError, "no 'unit'"),
        ({"eef": {"kind": "pose", "frame": "base"}}, ConfigError, "say how the pose is written"),
        ({"eef": {"kind": 3}}, ConfigError, "must be a text"),
        ({3: None}, ConfigError, "must be a text"),
        ({"eef": {"kind": "pose matrix"}}, FrameError, "is in a frame; say frame"),
        ({"eef": {"kind": "invariant", "frame": "base"}}, FrameError, "leave frame out"),
        ({"eef": {"kind": "invariant", "frame": ""}}, FrameError, "leave frame out"),
    ],
)
def test_what_states_no_kind_is_refused(given: Any, error: type, words: str) -> None:
    with pytest.raises(error, match=words):
        stated_kinds("test", given)


def test_a_stream_that_is_not_there_is_named_with_those_near() -> None:
    check_stated_names("test", ["eef"], ["eef", "joints"])
    with pytest.raises(ConfigError, match=r"no stream 'eeff'.*'eef'"):
        check_stated_names("test", ["eeff"], ["eef", "joints"])


def test_values_that_are_not_of_the_stated_kind_are_an_error_of_the_capture_with_the_way_out() -> None:
    assert signal_of("test", "eef", torch.tensor([[0.0, 0, 0, 0, 0, 0, 1]]), POSE).frame == "base"
    with pytest.raises(CaptureError, match=r"eef.*signals=\{'eef': None\}"):
        signal_of("test", "eef", torch.zeros(1, 7), POSE)
