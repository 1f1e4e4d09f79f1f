"""Arrays of a camera's driver -> the frame of a stream: what the first frame has shown is not asked again."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from pcdata.errors import DTypeError, ShapeError
from pcdata.functional.depth.stored_depth import depth_in_metres
from pcdata.geometry.rigid import check_rigid
from pcdata.structures import DepthFrame
from pcdata.structures.image_arrays import image_tensor, pose_tensor
from pcdata.structures.structure import derived

WHERE = "LivePipeline"


class ArrayReader:
    """Makes frames like the first one out of arrays; depth and colors go into memory that is used again.

    The numbers are those of ``DepthFrame.from_numpy``. Its look at the unit and at marks for "no reading" is taken at
    the first array only.
    """

    def __init__(self, like: DepthFrame, metres_per_unit: float | None, invalid_values: Collection[int]) -> None:
        self._like = derived(like, labels=None, confidence=None, recorded_signals={})
        self._unit, self._invalid = metres_per_unit, invalid_values
        self._dtype: np.dtype[Any] | None = None
        self._rooms: dict[str, list[Tensor]] = {}

    def frame(
        self,
        depth: ArrayLike,
        colors: ArrayLike | None,
        confidence: ArrayLike | None,
        pose: ArrayLike | None,
        *,
        keep: Tensor | None,
    ) -> DepthFrame:
        """Return a frame that lives until the next is made, but for the depth that is to be kept.

        Raises:
            ShapeError, DTypeError: an array of another form than in the first frame, or one more or less.
            CaptureError: negative depth.
            PoseError: a pose that is none.
        """
        like = self._like
        shape = tuple(like.depth.shape)
        stored = np.asarray(depth)
        stored = stored[None] if shape[0] == 1 and stored.shape == shape[1:] else stored
        if stored.shape != shape:
            raise ShapeError(f"{WHERE}: depth is {np.asarray(depth).shape} and was {shape} in the first frame")
        for name, given in (("colors", colors), ("world_from_camera", pose)):
            if (given is None) != (getattr(like, name) is None):
                has = "has none" if given is None else "has some"
                raise ShapeError(f"{WHERE}: this frame {has} of {name}, unlike the first one")
        made: dict[str, Any] = {"depth": self._depth(stored, keep)}
        if colors is not None:
            made["colors"] = self._colors(np.asarray(colors), (*shape, 3))
        if confidence is not None:
            made["confidence"] = image_tensor(WHERE, "confidence", confidence, shape, dtypes=("uint8",))
        if pose is not None:
            made["world_from_camera"] = pose_tensor(WHERE, pose, shape[0])
            check_rigid(f"{WHERE}: pose", made["world_from_camera"])
        return derived(like, **{name: value.to(like.device, non_blocking=True) for name, value in made.items()})

    def _depth(self, stored: NDArray[Any], keep: Tensor | None) -> Tensor:
        if self._dtype is None:
            first = torch.from_numpy(depth_in_metres(WHERE, stored, self._unit, self._invalid))
            self._dtype = stored.dtype
            return first
        if stored.dtype != self._dtype:
            raise DTypeError(f"{WHERE}: depth is {stored.dtype} and was {self._dtype} in the first array")
        if stored.dtype != np.uint16 or self._unit is None:
            return torch.from_numpy(depth_in_metres(WHERE, stored, self._unit, self._invalid))
        room = self._room("depth", stored.shape, torch.float32, keep)
        metres = room.numpy()
        np.multiply(stored, self._unit, out=metres, dtype=np.float64, casting="same_kind")
        for mark in self._invalid:
            metres[stored == mark] = 0.0
        return room

    def _colors(self, colors: NDArray[Any], shape: tuple[int, ...]) -> Tensor:
        colors = colors[None] if shape[0] == 1 and colors.shape == shape[1:] else colors
        if colors.shape != shape or colors.dtype != np.uint8:
            raise ShapeError(
                f"{WHERE}: colors are {colors.dtype} {colors.shape}; they must be uint8 {shape}, RGB at the depth's "
                "pixels, as in the first frame"
            )
        room = self._room("colors", shape, torch.uint8)
        np.copyto(room.numpy(), colors)
        return room

    def _room(self, name: str, shape: tuple[int, ...], dtype: torch.dtype, keep: Tensor | None = None) -> Tensor:
        rooms = self._rooms.setdefault(name, [])
        for room in rooms:
            if keep is None or room.data_ptr() != keep.data_ptr():
                return room
        rooms.append(torch.empty(shape, dtype=dtype, device="cpu"))
        return rooms[-1]

    def give_away(self, tensors: list[Tensor]) -> None:
        """Never write again into memory that these tensors share: they are somebody else's now."""
        theirs = {tensor.untyped_storage().data_ptr() for tensor in tensors if tensor.device.type == "cpu"}
        for rooms in self._rooms.values():
            rooms[:] = [room for room in rooms if room.untyped_storage().data_ptr() not in theirs]
