"""Pickles of arrays and containers come back as Python's own unpickler has them; of anything else nothing is run."""

from __future__ import annotations

import io
import pickle
import pickletools
import struct
import time
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pcdata.errors import CaptureError
from pcdata.io.arrays.plain_pickles import read_plain_pickle
from tests.rlbench_demos import Demo, Observation, pickled_demo

VALUES = {
    "rows": np.arange(6.0).reshape(2, 3),
    "columns": np.asfortranarray(np.arange(6, dtype=">i4").reshape(2, 3)),
    "switches": np.array([True, False]),
    "scalar": np.float32(3.5),
    "none_d": np.array(5),
    "empty": np.zeros((0, 3), np.float16),
    "slice": np.arange(20)[::2],
    "plain": [1, -(2**70), 2.5, None, True, "x" * 300, (1, (2,), [3]), {"a": {"b": 1}}, b"bytes", b""],
    "ordered": OrderedDict(a=1),
}


def as_lists(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: as_lists(one) for key, one in value.items()}
    return [as_lists(one) for one in value] if isinstance(value, (list, tuple)) else value


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_what_python_pickles_of_arrays_and_containers_comes_back(protocol: int) -> None:
    found = read_plain_pickle("test", pickle.dumps(VALUES, protocol))
    assert list(found) == list(VALUES)
    for name in ("rows", "columns", "switches", "none_d", "empty", "slice"):
        assert np.array_equal(found[name], VALUES[name])
        assert found[name].dtype == VALUES[name].dtype
    assert found["scalar"] == 3.5
    assert found["plain"] == as_lists(VALUES["plain"])
    assert found["ordered"] == {"a": 1}


def test_the_modules_of_any_numpy_are_known() -> None:
    program = pickle.dumps(np.arange(3), 2)
    for core in (b"numpy.core.multiarray", b"numpy._core.multiarray"):
        other = program.replace(b"numpy._core.multiarray", core).replace(b"numpy.core.multiarray", core)
        assert read_plain_pickle("test", other).tolist() == [0, 1, 2]


def test_observations_are_dictionaries_of_their_attributes() -> None:
    found = read_plain_pickle("test", pickled_demo([Observation(gripper_open=1.0, joint_positions=np.arange(7.0))]))
    (only,) = found["_observations"]
    assert only["gripper_open"] == 1.0
    assert only["joint_positions"].tolist() == list(range(7))
    assert isinstance(Demo([]), Demo)


# -- what is none of that ----------------------------------------------------------------------------------------------

RUN: list[str] = []  # what a pickle managed to run


def ran(*arguments: Any) -> str:
    RUN.append("ran")
    return "ran"


class Reducing:
    def __init__(self, *reduced: Any) -> None:
        self.reduced = reduced

    def __reduce__(self) -> Any:
        return self.reduced


def hostile(tmp_path: Path) -> dict[str, Any]:
    import builtins
    import os

    target = str(tmp_path / "run")
    return {
        "function": Reducing(ran, ()),
        "system": Reducing(os.system, (f"touch {target}",)),
        "eval": Reducing(builtins.eval, (f"open({target!r}, 'w')",)),
        "exec": Reducing(builtins.exec, (f"open({target!r}, 'w')",)),
        "getattr": Reducing(builtins.getattr, ("text", "join")),
        "import": Reducing(builtins.__import__, ("os",)),
        "open": Reducing(open, (target, "w")),
        "numpy load": Reducing(np.load, (target,)),
        "numpy fromfile": Reducing(np.fromfile, (target,)),
        "numpy savetxt": Reducing(np.savetxt, (target, [1])),
        "numpy zeros": Reducing(np.zeros, (10**10,)),
        "bytearray": Reducing(bytearray, (10**10,)),
        "bytes": Reducing(bytes, (10**10,)),
        "range": range(10),
        "set": {1, 2},
        "complex": 1 + 2j,
        "class": Path("x"),
        "objects": np.array([Reducing(ran, ())], object),
        "texts": np.array(["a"]),
        "fields": np.zeros(2, [("a", "f4"), ("b", "i4")]),
        "matrix": np.ma.masked_array([1, 2]),
    }


@pytest.mark.parametrize("protocol", [0, 1, 2, 4, 5])
def test_nothing_else_is_read_and_nothing_is_run(protocol: int, tmp_path: Path) -> None:
    for name, value in hostile(tmp_path).items():
        for wrapped in (value, {"meta": [value]}):
            with pytest.raises(CaptureError):
                read_plain_pickle(name, pickle.dumps(wrapped, protocol))
    assert RUN == []
    assert not (tmp_path / "run").exists()


def program(*parts: bytes) -> bytes:
    return b"\x80\x04" + b"".join(parts) + b"."


def test_what_a_holder_is_given_is_never_called() -> None:
    name = b"crlbench.demo\nDemo\n"
    for made in (
        program(name, b"(", name, b"tR"),  # called with itself
        program(name, b")\x81", b"}(\x8c\x08__init__", name, b"ub", b"}", b"b"),  # a state twice
        program(name, b"(K\x01t\x81"),  # with an argument
        program(name),  # the class itself
        program(b"cos\nsystem\n"),
        program(b"\x8c\x02os\x8c\x06system\x93"),
        program(b"K\x01\x8c\x06system\x93"),
        program(b"crlbench.demo\nDemo.__init__\n"),
        program(b"cnumpy\nload\n"),
        program(b"cnumpy\nndarray\n", b"(K\x0at\x81"),
    ):
        with pytest.raises(CaptureError):
            read_plain_pickle("test", made)


def test_few_bytes_never_become_many() -> None:
    array = pickle.dumps(np.arange(4, dtype=np.float64), 2)
    laughs = b"\x8c\x01x\x94" + b"".join(b"](" + 9 * (b"h" + bytes([n])) + b"e\x94" for n in range(40))
    tuples = b"K\x01\x94" + b"".join(b"h" + bytes([n]) + b"h" + bytes([n]) + b"\x86\x94" for n in range(60))
    loop = b"]\x94h\x00a"  # a list in itself
    claims = array.replace(b"K\x04\x85", b"\x8a\x06\x00\x00\x00\x00\x00\x01\x85")
    assert claims != array
    for made in (
        program(laughs),
        program(tuples),
        program(loop),
        program(tuples + b"cnumpy\ndtype\nh" + bytes([60]) + b"\x85R"),  # a dtype that is such a tuple
        program(tuples + b"cnumpy\ndtype\n(\x8c\x02f8h" + bytes([60]) + b"h" + bytes([60]) + b"tR"),
        program(b"}h" + bytes([60]) + b"K\x01s"),
        program(tuples + b"}h" + bytes([60]) + b"K\x01s"),  # a key that is one
        claims,
        program(b"\x8e" + struct.pack("<Q", 10**10) + b"abc"),
        program(b"B" + struct.pack("<I", 2**31) + b"abc"),
        program(b"\x8d" + struct.pack("<Q", 2**63) + b"abc"),
        program(b"\x8b" + struct.pack("<I", 2**30) + b"abc"),
        program(b"]" * 100_000),
        program(b"(" * 100_000 + b"t" * 100_000),
    ):
        start = time.monotonic()
        with pytest.raises(CaptureError):
            read_plain_pickle("test", made)
        assert time.monotonic() - start < 10


def test_one_array_named_many_times_counts_as_many() -> None:
    array = np.zeros(5_000, np.uint8)
    assert len(read_plain_pickle("test", pickle.dumps([array] * 100))) == 100
    with pytest.raises(CaptureError, match="unfolds to more than"):
        read_plain_pickle("test", pickle.dumps([array] * 1_000))


def test_damage_anywhere_is_one_typed_error_or_other_values() -> None:
    whole = pickle.dumps(VALUES, 4)
    random = np.random.default_rng(0)
    for _ in range(300):
        broken = bytearray(whole)
        for place in random.integers(0, len(whole), 3):
            broken[place] = random.integers(256)
        for made in (bytes(broken), bytes(broken[: random.integers(len(broken))])):
            try:
                read_plain_pickle("test", made)
            except CaptureError:
                continue
    assert [one.name for one, *_ in pickletools.genops(io.BytesIO(whole))][-1] == "STOP"
