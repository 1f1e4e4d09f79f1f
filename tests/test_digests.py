"""The script that proves results unchanged sees every change: the short form of benchmarks/digests.py."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import digest_operations
import digest_transforms
import digests
from digest_hash import Many, digest, digests_of
from digest_inputs import base_cloud, small_frame

from pcdata.contracts.dispatch import why_unavailable

SUBSET = (
    "op/knn/torch/ties",
    "inner/pick_rows",
    "function/voxel_mean",
    "write/color",
)


@pytest.fixture(scope="module")
def cases():
    return list(digests.all_cases())


def test_every_case_has_a_name_of_its_own(cases):
    names = [name for name, _ in cases]
    assert len(set(names)) == len(names)
    assert {name.split("/")[0] for name in names} >= {"op", "inner", "fusion", "transform", "store", "export", "check"}


@pytest.mark.skipif(why_unavailable("cpu") is not None, reason="what has a kernel alone is registered with it")
def test_every_operation_and_transform_has_an_example():
    assert digest_operations.without_example() == []
    assert digest_transforms.without_example() == []


def test_two_runs_give_equal_digests(cases, tmp_path):
    first, second = (digests.record(iter(cases), only=SUBSET) for _ in range(2))
    assert digests.differences(first, second) == []
    assert all(any(key.startswith(prefix) for key in first) for prefix in SUBSET)
    digests.write(first, tmp_path / "a.json")
    assert json.loads((tmp_path / "a.json").read_text()) == first
    lines = (tmp_path / "a.json").read_text().splitlines()
    assert len(lines) == len(first) + 2
    assert digests.compare(tmp_path / "a.json", tmp_path / "a.json") == 0


def test_a_changed_a_missing_and_a_new_digest_are_told(tmp_path, capsys):
    for name, found in {"before": {"a": "1", "b": "2", "c": "3"}, "after": {"a": "1", "b": "9", "d": "4"}}.items():
        digests.write(found, tmp_path / f"{name}.json")
    assert digests.main(["--compare", str(tmp_path / "before.json"), str(tmp_path / "after.json")]) == 1
    assert [line.split() for line in capsys.readouterr().out.splitlines()[:-1]] == [
        ["changed", "b"],
        ["missing", "c"],
        ["new", "d"],
    ]


VALUES = {
    "a bit": (torch.tensor([1.0]), torch.tensor([1.0]).nextafter(torch.tensor(2.0))),
    "a dtype": (torch.tensor([1, 2]), torch.tensor([1, 2], dtype=torch.int32)),
    "a shape": (torch.zeros(2, 3), torch.zeros(3, 2)),
    "an order": ([1, 2], [2, 1]),
    "a name": ({"a": 1}, {"b": 1}),
    "none and zero": (None, 0),
    "a verdict": (("pass", 0.5), ("fail", 0.5)),
    "an empty list": ([], [[]]),
    "a sign": (np.float64(0.0), np.float64(-0.0)),
}


@pytest.mark.parametrize(("one", "other"), VALUES.values(), ids=VALUES)
def test_a_digest_sees_the_least_difference(one, other):
    assert digest(one) == digest(one)
    assert digest(one) != digest(other)


def test_strides_and_nan_change_nothing():
    matrix = torch.rand(3, 4, generator=torch.Generator().manual_seed(0))
    assert digest(matrix.mT.contiguous().mT) == digest(matrix)
    assert digest(float("nan")) == digest(float("inf") - float("inf"))


def test_every_field_of_a_cloud_and_a_capture_counts_and_its_facts_apart():
    cloud, frame = base_cloud(), small_frame()
    same = dict(digests_of("cloud", cloud))
    moved = dict(digests_of("cloud", cloud.with_meta([{"seen": 1}] * cloud.num_clouds)))
    assert same.keys() == {"cloud", "cloud facts"}
    assert same["cloud"] == moved["cloud"]
    assert same["cloud facts"] != moved["cloud facts"]
    changes = [
        replace(cloud, labels=cloud.labels + 1),
        replace(cloud, extra={**cloud.extra, "weight": cloud.extra["weight"] * 2}),
        replace(cloud, viewpoint=cloud.viewpoint + 1),
    ]
    assert len({digest(one) for one in [cloud, *changes]}) == 4
    assert digest(frame) != digest(replace(frame, confidence=frame.confidence.flip(2)))


def test_many_results_of_a_case_have_digests_of_their_own():
    assert [key for key, _ in digests_of("case", Many({"a": 1, "b": Many({"c": 2})}))] == ["case/a", "case/b/c"]
