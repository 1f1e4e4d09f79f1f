"""From depth images to the tensors of the image networks."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pcdata.errors import CaptureError, DTypeError, NoReadingError, ShapeError
from pcdata.models.contract import InputTensor, ModelContract
from pcdata.structures import DepthFrame

_FILLERS = {"nearest": "FillHoles(rule='nearest')", "inpainted": "InpaintDepth()"}


def size_step(contract: ModelContract) -> str:
    """Say which step gives an image the size that the network takes."""
    same = contract.window == contract.image_size
    return f"{'CropCenter' if same else 'ResizeDepth'}(size={contract.image_size})"


def image_tensor(frames: Sequence[DepthFrame], contract: ModelContract, tensor: InputTensor) -> Tensor:
    """Stack the views of captures as (B, C, H, W) or (B, H, W, C) in the contract's channels.

    Raises:
        ShapeError: another image size than the network's.
        NoReadingError: holes are left in the depth.
        DTypeError: no colors where the network takes some.
    """
    for frame in frames:
        _check_frame(frame, contract)
    images = torch.cat([_MAKERS[channel.name](frames, contract) for channel in tensor.channels], dim=1)
    return images.permute(0, 2, 3, 1).contiguous() if tensor.axes[-1] == "C" else images


def _check_frame(frame: DepthFrame, contract: ModelContract) -> None:
    if not isinstance(frame, DepthFrame):
        raise DTypeError(f"{contract.name}: takes depth images, got a {type(frame).__name__}")
    if frame.size != contract.image_size:
        raise ShapeError(
            f"{contract.name}: takes images of (height, width) {contract.image_size}, got {frame.size}; end with "
            f"{size_step(contract)}"
        )
    holes = float((frame.depth == 0).float().mean())
    if holes > 0:
        raise NoReadingError(
            f"{contract.name}: {holes:.1%} of the depth of {frame.sample_id!r} is holes, which would count as surface "
            f"at the lens; put {_FILLERS[contract.holes]} after the crop"
        )


def _depth(frames: Sequence[DepthFrame], contract: ModelContract) -> Tensor:
    return torch.cat([frame.depth for frame in frames])[:, None]


def _relative(frames: Sequence[DepthFrame], contract: ModelContract) -> Tensor:
    depth = _depth(frames, contract)
    return (depth - depth.mean(dim=(1, 2, 3), keepdim=True)).clamp(-1.0, 1.0)


def _rgb_minus_mean(frames: Sequence[DepthFrame], contract: ModelContract) -> Tensor:
    images = [frame.colors for frame in frames]
    if any(image is None for image in images):
        raise CaptureError(f"{contract.name}: takes colors and a capture has none")
    colors = torch.cat([image for image in images if image is not None]).permute(0, 3, 1, 2).float() / 255.0
    return colors - colors.mean(dim=(1, 2, 3), keepdim=True)


_MAKERS = {"depth": _depth, "depth_relative": _relative, "rgb_minus_mean": _rgb_minus_mean}
