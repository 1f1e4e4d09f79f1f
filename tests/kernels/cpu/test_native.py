"""Calling the compiled core: what is refused instead of read astray."""

from __future__ import annotations

import ctypes.util
from pathlib import Path

import pytest
import torch

from pcdata.contracts.dispatch import why_unavailable
from pcdata.kernels.cpu import native

pytestmark = pytest.mark.skipif(why_unavailable("cpu") is not None, reason=str(why_unavailable("cpu")))


def test_a_library_built_from_other_declarations_is_refused_with_what_to_do(monkeypatch: pytest.MonkeyPatch):
    path = native._folder() / "libpcdata_baseline.so"
    assert native.load(path)
    monkeypatch.setattr(native, "INTERFACE_NUMBER", native.INTERFACE_NUMBER ^ 1)
    with pytest.raises(OSError, match=r"libpcdata_baseline\.so was built from other declarations .*; reinstall pcdata"):
        native.load(path)


def test_a_library_without_a_number_is_refused():
    other = ctypes.util.find_library("m")
    if other is None:
        pytest.skip("no other library to load")
    with pytest.raises(OSError, match="was built from other declarations"):
        native.load(Path(other))


def test_tensors_of_another_dtype_than_the_header_declares_are_refused():
    points, inside, finite = torch.zeros(4, 3), native.room(4, torch.bool), native.room(1, torch.int64)
    corners = torch.zeros(3), torch.ones(3)
    native.call("pc_inside_box", points, 4, *corners, inside, finite)
    assert bool(inside.all())
    with pytest.raises(TypeError, match=r"pc_inside_box: points takes a tensor of torch\.float32, got torch\.float64"):
        native.call("pc_inside_box", points.double(), 4, *corners, inside, finite)
    with pytest.raises(TypeError, match=r"pc_inside_box: inside takes a tensor of torch\.uint8, got int"):
        native.call("pc_inside_box", points, 4, *corners, 0, finite)


def test_calls_with_too_few_arguments_and_fractions_for_counts_are_refused():
    finite = native.room(1, torch.int64)
    with pytest.raises(TypeError, match="pc_inside_box takes 6 arguments, got 1"):
        native.call("pc_inside_box", torch.zeros(4, 3))
    with pytest.raises(TypeError, match="pc_inside_box: argument 3: "):
        native.call("pc_inside_box", torch.zeros(4, 3), 4.5, torch.zeros(3), torch.ones(3), None, finite)


def test_huge_pages_are_asked_for_once_where_memory_is_kept_and_each_time_where_it_is_not(monkeypatch):
    asked = []
    monkeypatch.setattr(native, "call", lambda *arguments: asked.append(arguments[0]))
    monkeypatch.setattr(native, "_advised", set())
    monkeypatch.setattr(native, "_kept_below", 0)
    block, other = torch.empty(8 << 20, dtype=torch.uint8), torch.empty(8 << 20, dtype=torch.uint8)
    given = iter([block, block, block, block, other, other])
    monkeypatch.setattr(native.torch, "empty", lambda *_, **__: next(given))
    for times in (1, 2):
        native.room_for(((8 << 20,), torch.uint8))
        assert len(asked) == times
    native.remember_advice(32 << 20)
    for times in (3, 3, 4, 4):
        native.room_for(((8 << 20,), torch.uint8))
        assert len(asked) == times
    native.remember_advice(4 << 20)  # now the block is too large to be kept
    given = iter([block])
    native.room_for(((8 << 20,), torch.uint8))
    assert len(asked) == 5
