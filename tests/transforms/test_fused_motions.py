"""Motions in a row run as one pass, and nobody can tell."""

from __future__ import annotations

import pytest
import torch

from pcdata.contracts.dispatch import INNER
from pcdata.errors import PoseError
from pcdata.rng import Streams
from pcdata.structures.structure import derived
from pcdata.transforms import (
    Compose,
    RandomFlip,
    RandomJitter,
    RandomPointDropout,
    RandomRotation,
    RandomScale,
    RandomTranslation,
)
from pcdata.transforms.fused_motions import motions_from
from tests.factories import assert_same, cloud_in_base

CHAIN = [
    RandomRotation(),
    RandomScale(per_axis=True),
    RandomJitter(sigma=0.02, clip=0.03),
    RandomTranslation(),
    RandomFlip(),
    RandomPointDropout(),
    RandomScale(about="centroid"),
    RandomJitter(),
    RandomRotation(axis=None),
]


@pytest.mark.parametrize("counts", [(17,), (400, 0, 3, 65)])
def test_a_chain_gives_what_its_steps_give_one_after_another(counts):
    chain, cloud = Compose(CHAIN), cloud_in_base(counts)
    together = chain(cloud, generator=Streams(range(len(counts))))
    *_, (_, one_by_one) = chain.step_through(cloud, generator=Streams(range(len(counts))))
    assert_same(together, one_by_one)
    assert together.history == one_by_one.history
    assert together.layout is None


@pytest.mark.parametrize("steps", [[RandomRotation(), RandomJitter()], CHAIN[:6], CHAIN[5:6], CHAIN], ids=len)
def test_clouds_of_ones_own_come_out_the_same_in_their_memory(steps):
    chain, cloud = Compose(steps), cloud_in_base((70, 5, 333, 1))
    wanted = chain(cloud, generator=Streams([1, 2, 3, 4]))
    memory = cloud.points.data_ptr()
    made = chain.consume(cloud, generator=Streams([1, 2, 3, 4]))
    assert_same(made, wanted)
    assert made.history == wanted.history
    assert made.points.data_ptr() == memory or len(steps) == len(CHAIN)


@pytest.mark.parametrize("steps", [[RandomRotation(), RandomJitter()], CHAIN[:6], CHAIN[5:6], CHAIN], ids=len)
@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_points_are_moved_from_where_each_cloud_has_them(steps, backend, monkeypatch):
    if backend == "torch":
        for name in ("move_points", "gather_kept"):
            monkeypatch.setattr(INNER[name], "kernels", {})
    chain, cloud = Compose(steps), cloud_in_base((70, 0, 333, 1))
    wanted = chain(cloud, generator=Streams([1, 2, 3, 4]))
    fields = chain.fields_read_once
    assert fields == (("points",) if len(steps) == 2 else ("points", "colors", "source_index"))
    parts = {name: [getattr(part, name).clone() for part in reversed(cloud.unbatch())][::-1] for name in fields}
    sources = {name: torch.tensor([part.data_ptr() for part in own]) for name, own in parts.items()}
    rooms = {name: torch.full_like(getattr(cloud, name), -77) for name in fields}
    made = chain.consume(derived(cloud, **rooms), generator=Streams([1, 2, 3, 4]), sources=sources)
    assert_same(made, wanted)
    assert made.history == wanted.history


def test_rows_that_were_left_are_there_for_steps_that_run_alone():
    chain, cloud = Compose([RandomRotation(), RandomPointDropout()]), cloud_in_base((20, 5))
    wanted = chain(cloud, generator=Streams([1, 2]))
    parts = {name: [getattr(one, name).clone() for one in cloud.unbatch()] for name in chain.fields_read_once}
    sources = {name: torch.tensor([part.data_ptr() for part in own]) for name, own in parts.items()}
    empty = derived(cloud, **{name: torch.full_like(getattr(cloud, name), -77) for name in sources})
    chain.steps[0].register_forward_hook(lambda *_: None)  # somebody watches it
    assert chain.fields_read_once == ()
    made = chain.consume(empty, generator=Streams([1, 2]), sources=sources)
    assert_same(made, wanted)


def test_only_steps_that_do_not_look_at_the_points_run_together():
    steps = Compose(CHAIN).steps
    assert [motions_from(steps, position) for position in range(len(steps))] == [6, 5, 4, 3, 2, 1, 0, 2, 1]
    watched = RandomScale()
    watched.register_forward_hook(lambda *_: None)
    assert motions_from([RandomRotation(), watched, RandomScale()], 0) == 1


def test_a_step_that_refuses_says_so_as_it_would_alone():
    cloud = cloud_in_base((5,)).with_signal("grasp", torch.eye(4)[None], "pose matrix", "base")
    chain = Compose([RandomRotation(), RandomFlip(probability=(1.0, 0.0, 0.0))])
    with pytest.raises(PoseError) as told:
        chain(cloud, generator=Streams([3]))
    assert any("in RandomFlip(" in note for note in told.value.__notes__)
