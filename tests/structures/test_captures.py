"""Captures are gone through, and taken by place or id, whatever they come from."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pcdata import open_source
from pcdata.errors import CaptureError, DTypeError
from pcdata.synthetic import SyntheticSource
from tests.factories import tabletop_frame
from tests.validation.captures import store


@pytest.fixture(scope="module", params=["files", "part", "made"])
def captures(request, tmp_path_factory):
    if request.param == "made":
        return SyntheticSource(num_scenes=3, size=(24, 32))
    source = open_source(
        store(tmp_path_factory.mktemp("captures") / "c", [tabletop_frame(1, seed=n) for n in range(4)])
    )
    return source.subset(source.ids[1:]) if request.param == "part" else source


def test_a_loop_loads_every_capture_in_order(captures):
    assert [frame.sample_id for frame in captures] == captures.ids
    assert [frame.sample_id for frame in captures] == captures.ids  # and again


def test_a_place_counted_from_either_end_and_an_id_load_one(captures):
    last = len(captures) - 1
    for place in (0, last, -1, -len(captures), np.int64(1), torch.tensor(1)):
        assert captures[place].sample_id == captures.ids[int(place)]
    for sample_id in captures.ids:
        assert torch.equal(captures[sample_id].depth, captures.load(sample_id).depth)
        assert sample_id in captures
    assert "elsewhere" not in captures


def test_what_is_no_place_and_no_id_says_what_to_do(captures):
    count = len(captures)
    for place in (count, -count - 1):
        with pytest.raises(IndexError, match=f"has {count} samples, none at place {place}"):
            captures[place]
    with pytest.raises(CaptureError, match="elsewhere"):
        captures["elsewhere"]
    for which in (slice(0, 2), 1.0, None):
        with pytest.raises(DTypeError, match=r"source\.subset\(source\.ids\[2:5\]\)"):
            captures[which]


def test_going_through_loads_no_more_than_is_taken(captures, monkeypatch):
    loaded = []
    own = type(captures).load
    monkeypatch.setattr(type(captures), "load", lambda self, name: loaded.append(name) or own(self, name))
    first = next(iter(captures))
    assert loaded == [first.sample_id] == captures.ids[:1]
