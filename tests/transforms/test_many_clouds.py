"""Many small clouds: a transform calls PyTorch as often for hundreds of them as for some, or its loop is known."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from pcdata.contracts.dispatch import why_unavailable
from tests.transforms.examples import ALL, NAMES, Example
from tests.transforms.test_contract import run

pytestmark = pytest.mark.skipif(why_unavailable("cpu") is not None, reason="counted with the compiled core")

SOME, MANY = (70, 66, 81) * 12, (70, 66, 81) * 40  # beyond the few that are gone through one by one, which is faster

# Transforms whose calls grow with the clouds, and why.
LOOPS = {
    "ClusterObjects": "every cloud's objects are numbered by their own sizes",
    "CompleteDepth": "a model completes one view at a time",
    "Compose": "has steps that loop",
    "Deproject": "every view's camera goes into its cloud's meta",
    "FuseTSDF": "views are integrated one after another",
    "MarkUnreliableDepth": "every view has its own camera and sensor",
    "MergeViews": "every view has its own pose",
    "RandomApply": "has steps that loop, and is given to some clouds alone",
    "RandomColorJitter": "kornia adjusts one image at a time",
    "RandomOneOf": "has steps that loop, and is given to some clouds alone",
    "RandomSensorNoise": "every view has its own camera and sensor",
    "RemovePlane": "a cloud has as many planes as it has",
    "Undistort": "every camera has its own lens",
}


class Calls(TorchDispatchMode):
    """Counts the calls of PyTorch's operators."""

    number = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.number += 1
        return function(*args, **(kwargs or {}))


def calls(example: Example, counts: tuple[int, ...]) -> int:
    data = example.make(counts)
    with Calls() as counted:
        run(example, data)
    return counted.number


def loops(name: str) -> bool:
    return name.rsplit("-", 1)[0] in LOOPS


@pytest.mark.parametrize(
    "example", [e for e, name in zip(ALL, NAMES) if not loops(name)], ids=[name for name in NAMES if not loops(name)]
)
def test_many_clouds_take_no_more_calls_than_some(example: Example):
    torch.manual_seed(0)
    some, many = (calls(example, counts) for counts in (SOME, MANY))
    assert many <= 1.2 * some + 20


@pytest.mark.parametrize("name", sorted(LOOPS))
def test_what_is_said_to_loop_does(name: str):
    examples = [example for example, own in zip(ALL, NAMES) if own.rsplit("-", 1)[0] == name]
    few, more = (70, 66) * 5, (70, 66) * 10
    assert any(calls(example, more) >= calls(example, few) + 10 for example in examples)
