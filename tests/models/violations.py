"""One way to break each rule, made from a contract's data alone: no contract is named here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from pcdata.models import ModelBatch, ModelContract, Role
from pcdata.models.contract import Channel, InputTensor
from tests.models.captures import with_tensor


def _columns(spec: InputTensor, name: str) -> slice:
    names = spec.channel_names
    start = sum(channel.width for channel in spec.channels[: names.index(name)])
    return slice(start, start + spec.channels[names.index(name)].width)


def _edited(batch: ModelBatch, spec: InputTensor, channel: Channel, edit: Callable[[Tensor], Tensor]) -> ModelBatch:
    """The batch with one channel of one tensor changed; rows and cells that only fill it stay."""
    rows = batch[spec.key].movedim(spec.axes.index("C"), -1).clone()
    filled = (rows != 0).any(dim=-1) if spec.content != "voxel_grid" else rows[..., -1] > 0
    part = rows[..., _columns(spec, channel.name)]
    part[filled] = edit(part[filled].clone())
    return with_tensor(batch, spec.key, rows.movedim(-1, spec.axes.index("C")).contiguous())


def wrong_frame(batch: ModelBatch, contract: ModelContract) -> ModelBatch:
    return replace(batch, frame_id="world" if batch.frame_id.startswith("camera") else "camera")


def wrong_unit(batch: ModelBatch, contract: ModelContract) -> ModelBatch:
    return replace(batch, unit="m" if batch.unit == "normalized" else "normalized")


def millimetres(batch: ModelBatch, contract: ModelContract) -> ModelBatch:
    """Values 1000 times too large, still called metres; what is clipped is clipped again."""
    spec, channel = contract.main, contract.main.channels[0]

    def thousandfold(values: Tensor) -> Tensor:
        large = values * 1000
        return large if channel.name != "depth_relative" else large.clamp(channel.low, channel.high)

    return _edited(batch, spec, channel, thousandfold)


def wrong_count(batch: ModelBatch, contract: ModelContract) -> ModelBatch:
    """One point fewer; of models that take any number a single point; of images one row fewer."""
    spec, tensor = contract.main, batch[contract.main.key]
    if contract.image_size is not None:
        return with_tensor(batch, spec.key, tensor.narrow(spec.axes.index("H"), 0, contract.image_size[0] - 1))
    if "N" in spec.axes:
        axis = spec.axes.index("N")
        return with_tensor(batch, spec.key, tensor.narrow(axis, 0, tensor.shape[axis] - 1))
    assert batch.counts is not None
    return replace(batch, counts=(1,) * len(batch.counts))


def wrong_order(batch: ModelBatch, contract: ModelContract) -> ModelBatch:
    """The first tensor's columns turned round by one, and said to be so."""
    spec = contract.main
    rolled = batch[spec.key].roll(1, dims=spec.axes.index("C"))
    names = tuple(reversed(spec.channel_names)) if len(spec.channels) > 1 else (f"{spec.channels[0].name} from z on",)
    changed = with_tensor(batch, spec.key, rolled)
    return replace(changed, channels={**batch.channels, spec.key: names})


def _moved_beyond(beyond: float, values: Tensor) -> Tensor:
    return values * 2 + beyond


def wrong_range(batch: ModelBatch, contract: ModelContract) -> ModelBatch | None:
    """The first channel with limits, twice as far from the middle of its limits, and one of its spans beyond."""
    for spec in contract.tensors:
        for channel in spec.channels:
            if channel.low is not None and channel.role is not Role.POSITION:
                assert channel.high is not None
                beyond = channel.high - channel.low + 1
                return _edited(batch, spec, channel, partial(_moved_beyond, beyond))
    return None


def wrong_layout(batch: ModelBatch, contract: ModelContract) -> ModelBatch:
    spec = contract.main
    axis = spec.axes.index("C")
    other = next(i for i in reversed(range(len(spec.axes))) if i != axis and spec.axes[i] != "B")
    return with_tensor(batch, spec.key, batch[spec.key].transpose(axis, other))


def missing_tensor(batch: ModelBatch, contract: ModelContract) -> ModelBatch:
    return replace(batch, tensors={f"{key}_": tensor for key, tensor in batch.tensors.items()})


def wrong_dtype(batch: ModelBatch, contract: ModelContract) -> ModelBatch:
    return with_tensor(batch, contract.main.key, batch[contract.main.key].double())


def wrong_normalization(batch: ModelBatch, contract: ModelContract) -> ModelBatch:
    """What is centered is moved away; what is not is centered."""
    spec, channel = contract.main, contract.main.channels[0]
    if contract.takes == "depth image":
        relative = channel.name == "depth_relative"
        return _edited(
            batch, spec, channel, lambda depth: (depth + 2.0).clamp(-1, 1) if relative else depth - depth.mean()
        )
    if contract.centering == "none":
        rows = batch[spec.key].movedim(spec.axes.index("C"), -1)
        if spec.axes[0] != "S":
            rows = rows.flatten(1, -2)
            return _centered_each(batch, contract)
        assert batch.counts is not None
        parts = [
            torch.cat([p[:, :3] - p[:, :3].double().mean(0).float(), p[:, 3:]], 1) for p in rows.split(batch.counts)
        ]
        return with_tensor(batch, spec.key, torch.cat(parts))
    return _edited(batch, spec, channel, lambda values: values - torch.tensor([0.3, 0.8, 0.7]))


def _centered_each(batch: ModelBatch, contract: ModelContract) -> ModelBatch:
    spec = contract.main
    singles = []
    for one in batch[spec.key]:
        single = replace(batch, tensors={spec.key: one[None]})
        moved = _edited(single, spec, spec.channels[0], lambda values: values - values.double().mean(0).float())
        singles.append(moved[spec.key])
    return with_tensor(batch, spec.key, torch.cat(singles))


def not_finite(batch: ModelBatch, contract: ModelContract) -> ModelBatch:
    tensor = batch[contract.main.key].clone()
    tensor.view(-1)[7] = float("nan")
    return with_tensor(batch, contract.main.key, tensor)


# The violation, and the rules of which one must fail.
VIOLATIONS: dict[str, tuple[Callable[[ModelBatch, ModelContract], ModelBatch | None], set[str]]] = {
    "frame": (wrong_frame, {"frame"}),
    "unit": (wrong_unit, {"unit"}),
    "millimetres": (millimetres, {"scale"}),
    "count": (wrong_count, {"count"}),
    "order": (wrong_order, {"channels"}),
    "range": (wrong_range, {"range"}),
    "layout": (wrong_layout, {"layout"}),
    "missing tensor": (missing_tensor, {"layout"}),
    "dtype": (wrong_dtype, {"dtype"}),
    "normalization": (wrong_normalization, {"normalization"}),
    "NaN": (not_finite, {"finite"}),
}
CHEAP = {"frame", "unit", "count", "order", "layout", "missing tensor", "dtype"}  # seen without reading values
