from __future__ import annotations

import random
import re
import textwrap
import threading

import numpy as np
import pytest
import torch

from pcdata import transforms as T
from pcdata.errors import ConfigError
from pcdata.rng import seeded
from tests.factories import cloud_in_base


def advised(message: str) -> str:
    """Return the lines of a message that are to be written into a class."""
    return "\n".join(line for line in message.splitlines() if line.startswith("    "))


def written(base: str, body: str) -> type:
    """Define a step as its author would."""
    code = f"class Mine({base}, abstract=True):\n{textwrap.indent(textwrap.dedent(body), '    ')}\n"
    space = {"T": T, "torch": torch, "np": np, "random": random, "__name__": __name__}
    exec(compile(code, "mine.py", "exec", dont_inherit=True), space)
    return space["Mine"]


UNDECLARED = {
    "streams": (
        "T.Transform",
        "def make_params(self, data, streams):\n    return {'drawn': streams.normal(2)}",
        "its streams but",
    ),
    "seeds": (
        "T.SelectTransform",
        "def pick(self, cloud, streams):\n    return streams.seeds(), cloud.ptr",
        "its streams but",
    ),
    "torch": (
        "T.SpatialTransform",
        "def make_params(self, data, streams):\n"
        "    return {'matrix': torch.diag_embed(torch.cat([torch.rand(3, 3), torch.ones(3, 1)], 1)).double()}",
        r"torch's global generator \(rand\)",
    ),
    "torch in place": (
        "T.Transform",
        "def transform(self, data, params):\n    return data.with_fields(points=data.points.clone().normal_())",
        r"torch's global generator \(normal_\)",
    ),
    "dropout": (
        "T.Transform",
        "def make_params(self, data, streams):\n    return {'drawn': torch.dropout(torch.ones(3), 0.5, train=True)}",
        "torch's global generator,",
    ),
    "numpy": (
        "T.Transform",
        "def make_params(self, data, streams):\n    return {'drawn': torch.tensor(np.random.rand(3))}",
        "numpy's global generator",
    ),
    "random": (
        "T.Transform",
        "def make_params(self, data, streams):\n    return {'drawn': torch.full((3,), random.random())}",
        "Python's global generator",
    ),
    "generator": (
        "T.Center",
        "def forward(self, data, *, generator):\n    torch.rand(1, generator=generator)\n    return data",
        "the generator but",
    ),
    "though it says it is random": (
        "T.Transform",
        "is_random = True\ndef make_params(self, data, streams):\n    return {'drawn': torch.randperm(3)}",
        r"torch's global generator \(randperm\)",
    ),
}


@pytest.mark.parametrize("case", UNDECLARED)
def test_a_step_that_draws_without_saying_so_is_told_the_lines_that_mend_it(case, monkeypatch):
    monkeypatch.setattr(threading, "active_count", lambda: 1)  # tests run side by side by means of threads
    base, body, what = UNDECLARED[case]
    rest = (
        ""
        if "def transform" in body or base != "T.Transform"
        else "\ndef transform(self, data, params):\n    return data"
    )
    cloud = cloud_in_base()
    with pytest.raises(ConfigError, match=rf"Mine draws from {what}") as caught:
        written(base, body + rest)()(cloud, generator=seeded(0))
    lines = advised(str(caught.value))
    assert len(lines.splitlines()) == 3
    kept = re.sub(r"(?s)def (make_params|pick|forward)\(.*?(?=\ndef|\Z)", "", body + rest)
    if case == "torch in place":
        kept = "def transform(self, data, params):\n    return data"
    mended = written(base, textwrap.dedent(lines) + "\n" + kept)()
    assert mended.is_random
    once, again, other = (mended(cloud, generator=seeded(seed)) for seed in (1, 1, 2))
    assert once.history == again.history
    if base != "T.Center":
        assert once.history != other.history or not torch.equal(once.points, other.points)


def test_draws_of_other_threads_are_not_held_against_a_step():
    step = written("T.Transform", "def transform(self, data, params):\n    np.random.rand(3)\n    return data")()
    release = threading.Event()
    other = threading.Thread(target=release.wait)
    other.start()
    try:
        step(cloud_in_base())
    finally:
        release.set()
        other.join()


def test_a_forward_without_generator_is_told_the_lines_that_mend_it():
    with pytest.raises(ConfigError, match="chains and datasets call it with generator") as caught:
        written("T.Center", "def forward(self, data):\n    return super().forward(data)")
    mended = written("T.Center", textwrap.dedent(advised(str(caught.value))))()
    cloud = cloud_in_base()
    mixed, own = (T.Compose([step, T.RandomFlip()])(cloud, generator=seeded(1)) for step in (mended, T.Center()))
    assert torch.equal(mixed.points, own.points)


@pytest.mark.parametrize(
    ("body", "what"),
    [
        (
            "def apply(self, data, params):\n    return data",
            r"apply: that name is nn.Module's(.|\n)*def transform\(self, ",
        ),
        ("def make_params(self, data):\n    return {}", r"make_params: (.|\n)*def make_params\(self, data, streams\):"),
        ("def transform(self, data):\n    return data", r"transform: (.|\n)*def transform\(self, data, params\):"),
        ("def pick(self, cloud):\n    return data", r"pick: (.|\n)*def pick\(self, cloud, streams\):"),
        ("is_random: bool = True", r"is_random: every step has .* no type: is_random = \.\.\."),
        ("transform: float = 1.0", r"transform: every step has something of this name; call the field otherwise$"),
        ("training: bool", r"training: every step has something of this name"),
        ("half: float = 0.5", r"half: every step has something of this name"),
    ],
)
def test_a_class_that_no_chain_could_run_is_refused_where_it_is_written(body, what):
    with pytest.raises(ConfigError, match=rf"^Mine\.{what}"):
        written("T.Transform", body)


@pytest.mark.parametrize("base", ["T.CropWorkspace", "T.RemovePlane"])
def test_a_pick_that_nothing_calls_is_refused_where_it_is_written(base):
    with pytest.raises(
        ConfigError, match=r"^Mine\.pick: is never called, as (\w+)\.make_params decides .*(.|\n)*def make_"
    ):
        written(base, "def pick(self, cloud, streams):\n    return cloud.ptr, cloud.ptr")


@pytest.mark.parametrize(
    ("base", "body"),
    [
        ("T.Transform", "def transform(self, data, params):\n    return self.pick(data, None)"),
        ("T.RemovePlane", "def _found(self, data):\n    return [self.pick(one, None) for one in data.unbatch()]"),
        ("T.CropWorkspace", "def make_params(self, data, streams):\n    return getattr(self, 'pick')(data, streams)"),
    ],
)
def test_a_pick_that_somebody_calls_is_left_alone(base, body):
    written(base, body + "\n" + "def pick(self, cloud, streams):\n    return cloud")


@pytest.mark.parametrize("base", ["T.RemoveRadiusOutliers", "T.RemoveStatisticalOutliers", "T.RemoveDuplicates"])
def test_a_subclass_picks_for_itself(base):
    mine = written(
        base, "def pick(self, cloud, streams):\n    return cloud.ptr[:-1], torch.arange(cloud.num_clouds + 1)"
    )
    assert mine()(cloud_in_base()).counts.tolist() == [1] * cloud_in_base().num_clouds


def test_a_step_without_its_work_says_what_to_write():
    with pytest.raises(NotImplementedError, match=r"Mine: write the method transform\(self, data, params\)"):
        written("T.Transform", "n: int = 1")()(cloud_in_base())


def test_the_record_of_a_step_follows_its_fields_and_is_the_clouds_own():
    step, cloud = T.CropWorkspace(frame="base", lower=(-1, -1, -1), upper=(1, 1, 1)), cloud_in_base()
    first = step(cloud).history[0][-1]["fields"]
    first["lower"][0] = 5.0
    step.upper = (2.0, 2.0, 2.0)
    again = step(cloud).history[0][-1]["fields"]
    assert again == {**step.to_config()["CropWorkspace"], "lower": [-1.0, -1.0, -1.0], "upper": [2.0, 2.0, 2.0]}
    apply = T.RandomApply(step=T.RandomScale(), probability=1.0)
    apply(cloud, generator=seeded(0))
    apply.step.low = 0.5
    assert apply(cloud, generator=seeded(0)).history[0][-1]["fields"]["step"]["RandomScale"]["low"] == 0.5
