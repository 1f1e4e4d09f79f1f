"""Every kind of batch moves to a device and into page-locked memory as a whole, and keeps its dtypes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from pcdata import (
    CloudDataset,
    EpisodeWindows,
    collate_fixed,
    collate_packed,
    collate_padded,
    collate_windows,
    fit_normalizers,
)
from pcdata.build import config_from_yaml
from pcdata.errors import DTypeError
from pcdata.models import ModelBatch
from pcdata.structures.structure import Structure
from pcdata.synthetic import TeleopSource

SOURCE = TeleopSource(num_episodes=1, num_views=1, size=(12, 16))
CHAIN = config_from_yaml(
    "depth: [Deproject]\ncloud: [ToFrame: {frame: base}, RandomSample: {num_points: 16, if_short: repeat}]"
).pipeline


def model_batch() -> ModelBatch:
    clouds = clouds_of(collate_fixed)
    return ModelBatch(
        tensors={"point_cloud": clouds.points}, signals=dict(clouds.signals), source_from_cloud=clouds.source_from_cloud
    )


def clouds_of(collate: Any) -> Any:
    dataset = CloudDataset(SOURCE, CHAIN)
    return collate([dataset[0], dataset[1]])


def windows() -> Any:
    dataset = EpisodeWindows(CloudDataset(SOURCE, CHAIN), 2, 4)
    return collate_windows([dataset[0], dataset[5]])


BATCHES = {
    "packed": lambda: clouds_of(collate_packed),
    "padded": lambda: clouds_of(collate_padded),
    "fixed": lambda: clouds_of(collate_fixed),
    "windows": windows,
    "of a model": model_batch,
    "a capture": lambda: SOURCE.load(SOURCE.ids[0]),
    "a normalizer": lambda: fit_normalizers(CloudDataset(SOURCE, CHAIN), ["joints"])["joints"],
}


def tensors_in(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, (Mapping, Structure)):
        for one in (value if isinstance(value, Mapping) else vars(value)).values():
            yield from tensors_in(one)
    elif isinstance(value, (list, tuple)):
        for one in value:
            yield from tensors_in(one)


@pytest.mark.parametrize("name", BATCHES)
def test_a_loader_that_pins_memory_pins_every_tensor_of_a_batch(name, monkeypatch):
    from torch.utils.data._utils.pin_memory import pin_memory

    batch, pinned = BATCHES[name](), []

    def copy_of(tensor: Tensor, *args: Any) -> Tensor:
        pinned.append(tensor.clone())
        return pinned[-1]

    monkeypatch.setattr(Tensor, "pin_memory", copy_of)
    found = pin_memory(batch, "cpu")  # what the loader calls
    assert type(found) is type(batch)
    held, before = list(tensors_in(found)), list(tensors_in(batch))
    assert {id(one) for one in held} == {id(one) for one in pinned}
    assert all(torch.equal(one, was) and one.dtype == was.dtype for one, was in zip(held, before, strict=True))
    if hasattr(batch, "signals") and name != "a capture":
        assert found.signals["instruction"] == batch.signals["instruction"]


@pytest.mark.parametrize("name", BATCHES)
def test_a_batch_moves_as_a_whole_without_waiting(name, monkeypatch):
    batch, flags, real = BATCHES[name](), [], Tensor.to

    def noted(tensor: Tensor, *args: Any, **options: Any) -> Tensor:
        flags.append((args, options))
        return real(tensor, *args, **options)

    monkeypatch.setattr(Tensor, "to", noted)
    moved = batch.to("meta", non_blocking=True)
    monkeypatch.undo()
    assert {tensor.device.type for tensor in tensors_in(moved)} == {"meta"}
    assert flags == [(("meta",), {"non_blocking": True})] * len(list(tensors_in(batch)))
    assert [one.dtype for one in tensors_in(moved)] == [one.dtype for one in tensors_in(batch)]


@pytest.mark.parametrize("given", [torch.float64, torch.half, None, 1.5, True, torch.zeros(1)])
@pytest.mark.parametrize("name", BATCHES)
def test_what_is_no_device_is_refused(name, given):
    with pytest.raises(DTypeError, match=r"to: takes a device, got .*batch\.points\.to\(device, dtype\)"):
        BATCHES[name]().to(given)
