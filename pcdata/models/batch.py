"""ModelBatch: named tensors that remember how they came about."""

from __future__ import annotations

from collections.abc import Callable, ItemsView, Iterator, KeysView, Mapping, Sequence, ValuesView
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelBatch:
    """The tensors that a model takes, by the names of its own code, and what a check or a prediction needs to know.

    Empty texts and None mean "not known": tensors from a foreign file come without them.
    """

    tensors: Mapping[str, Tensor]
    model: str = ""  # the contract that it was made for
    choices: Mapping[str, Any] = field(default_factory=dict)
    channels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # names of the channels, per tensor
    frame_id: str = ""
    unit: str = ""
    counts: tuple[int, ...] | None = None  # points of each cloud
    steps: tuple[str, ...] | None = None  # names of the transforms that made the first cloud
    source_from_cloud: Tensor | None = None  # (B, 4, 4) float64
    source_frame: str = ""
    frames: Mapping[str, Tensor] = field(default_factory=dict)  # frame name -> (B, 4, 4) frame_from_source
    meta: Sequence[Mapping[str, Any]] = ()

    # Not a collections Mapping: a DataLoader that pins memory would rebuild that as a plain dict of tensors.

    def keys(self) -> KeysView[str]:
        """The names of the tensors."""
        return self.tensors.keys()

    def values(self) -> ValuesView[Tensor]:
        """The tensors."""
        return self.tensors.values()

    def items(self) -> ItemsView[str, Tensor]:
        """Names and tensors."""
        return self.tensors.items()

    def __getitem__(self, key: str) -> Tensor:
        return self.tensors[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self.tensors)

    def __len__(self) -> int:
        return len(self.tensors)

    def to(self, device: torch.device | str, *, non_blocking: bool = False) -> ModelBatch:
        """Move all tensors to a device."""
        return self._map(lambda tensor: tensor.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> ModelBatch:
        """Copy all tensors to page-locked memory; a DataLoader with ``pin_memory=True`` calls this."""
        return self._map(lambda tensor: tensor.pin_memory())

    def _map(self, move: Callable[[Tensor], Tensor]) -> ModelBatch:
        source = self.source_from_cloud
        return replace(
            self,
            tensors={key: move(value) for key, value in self.tensors.items()},
            source_from_cloud=None if source is None else move(source),
            frames={name: move(matrix) for name, matrix in self.frames.items()},
        )

    def __repr__(self) -> str:
        shapes = ", ".join(f"{key} {tuple(value.shape)}" for key, value in self.tensors.items())
        return f"ModelBatch({self.model or 'any model'}: {shapes} in {self.frame_id or '?'!r} [{self.unit or '?'}])"
