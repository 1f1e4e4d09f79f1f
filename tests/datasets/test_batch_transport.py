"""Batches travel from workers in memory that is used again: nothing may change in them, and nothing be left behind."""

from __future__ import annotations

import gc
import os

import pytest
import torch
from torch.utils.data import DataLoader, Dataset, get_worker_info

from pcdata import PointCloud, collate_fixed, collate_packed, collate_padded
from pcdata.datasets import batch_transport
from pcdata.datasets.batch_transport import batch_memory

needs_proc = pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="Linux alone has files in memory")


class _Clouds(Dataset):
    """Clouds that say their number in every field."""

    def __init__(self, size: int = 12, laid: bool = False, needs_gradients: bool = False) -> None:
        self.size, self.laid, self.needs_gradients = size, laid, needs_gradients

    def __len__(self) -> int:
        return self.size

    def __getitem__(self, number: int) -> PointCloud:
        points = torch.full((5 + number % 3, 3), float(number))
        cloud = PointCloud(
            points=points,
            labels=torch.full((len(points),), number),
            extra={"height": points[:, :1].clone()},
            kinds={"height": "invariant"},
            frame_id="base",
            frames={"world": torch.eye(4, dtype=torch.float64)[None]},
            meta=[{"number": number, "process": os.getpid()}],
        )
        cloud = cloud.with_signal("action", torch.full((1, 7), float(number)), "invariant")
        cloud = cloud.with_signal("task", [f"task {number}"], "text")
        if self.laid and (memory := batch_memory(points.nbytes)) is not None:
            own = memory[: points.nbytes].view(torch.float32).view(points.shape)
            cloud = cloud.with_fields(points=own.copy_(points))
        return cloud


def told(batch) -> list:
    signals = batch.signals
    fields = [batch.points, batch.labels, batch.extra["height"], batch.frames["world"], signals["action"]]
    return [*(field.tolist() for field in fields), signals["task"], [one["number"] for one in batch.meta]]


@pytest.mark.parametrize("collate", [collate_packed, collate_padded])
def test_batches_that_are_kept_stay_what_they_were(collate):
    dataset = _Clouds(150)
    wanted = [told(batch) for batch in DataLoader(dataset, 2, collate_fn=collate)]
    kept = list(DataLoader(dataset, 2, num_workers=2, collate_fn=collate))
    assert [told(batch) for batch in kept] == wanted  # 75 batches: more than a worker has blocks


def test_a_part_of_a_batch_keeps_the_memory_of_all():
    parts = [
        batch.points[1:2].numpy() for batch in DataLoader(_Clouds(60), 2, num_workers=1, collate_fn=collate_packed)
    ]
    assert [part.ravel().tolist() for part in parts] == [[float(number)] * 3 for number in range(0, 60, 2)]


@needs_proc
def test_a_few_blocks_carry_all_batches():
    batches = (
        batch.points.data_ptr() for batch in DataLoader(_Clouds(200), 2, num_workers=1, collate_fn=collate_packed)
    )
    assert len({*batches}) <= 8


@needs_proc
def test_the_memory_of_workers_that_ended_is_given_back():
    loader = DataLoader(_Clouds(), 2, num_workers=2, collate_fn=collate_packed)
    batch = None
    for batch in loader:
        assert batch_transport._MAPPED, batch
    del batch
    gc.collect()
    assert not batch_transport._MAPPED


class _Told(Dataset):
    """Whether what a worker laid into the memory of a batch is where it was sent from."""

    def __len__(self) -> int:
        return 6

    def __getitem__(self, number: int) -> PointCloud:
        return _Clouds(laid=True)[number]


@needs_proc
def test_samples_laid_into_a_block_come_out_whole():
    loader = DataLoader(_Told(), batch_size=None, num_workers=1)
    assert [cloud.points[0, 0].item() for cloud in loader] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert batch_memory(100) is None  # no worker


class _Gradients(_Clouds):
    def __getitem__(self, number: int) -> PointCloud:
        assert get_worker_info() is not None
        return super().__getitem__(number).with_fields(points=torch.zeros(5, 3).requires_grad_())


def test_what_cannot_be_laid_down_goes_as_torch_sends_it():
    batch = next(iter(DataLoader(_Gradients(), batch_size=None, num_workers=1)))
    assert batch.points.requires_grad
    assert batch.labels.tolist() == [0] * 5


def test_fixed_batches_of_a_forked_loader_survive_another_fork():
    """Workers that are forked while a batch is held have copies of it, and must not give its memory away."""
    dataset = _Clouds(9)
    held = list(DataLoader(dataset, 3, num_workers=1, collate_fn=collate_packed))
    before = [told(batch) for batch in held]
    for _ in DataLoader(dataset, 3, num_workers=2, collate_fn=collate_packed):
        pass
    assert [told(batch) for batch in held] == before
    assert collate_fixed([dataset[0], dataset[0]]).points.shape == (2, 5, 3)
