"""ModelBatch: named tensors that remember how they came about."""

from __future__ import annotations

from collections.abc import ItemsView, Iterator, KeysView, Mapping, Sequence, ValuesView
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from pcdata.structures.structure import Structure


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelBatch(Structure):
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

    def __repr__(self) -> str:
        shapes = ", ".join(f"{key} {tuple(value.shape)}" for key, value in self.tensors.items())
        return f"ModelBatch({self.model or 'any model'}: {shapes} in {self.frame_id or '?'!r} [{self.unit or '?'}])"
