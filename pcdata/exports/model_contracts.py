"""Samples held to the contract of the model that they are exported for: the rules are those of ``pcdata.models``."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from pcdata.errors import ContractError, PcdataError
from pcdata.exports.exported_images import MANY
from pcdata.exports.target import Target
from pcdata.functional.rows import ptr_from_counts
from pcdata.models import ModelBatch, contract, preset, require
from pcdata.models.batching import batch_of
from pcdata.structures import DepthFrame, PointCloud
from pcdata.transforms import Deproject


def require_cloud(where: str, target: Target, cloud: PointCloud, **choices: Any) -> None:
    """Refuse one cloud that ``check(cloud, target.model, **choices)`` fails, but for what the loader does by itself.

    Raises:
        ContractError: every rule that failed, with what to do.
    """
    made = contract(target.model, **choices)
    try:
        batch = batch_of([cloud], made, choices)
        if "normalization" in target.left_to_loader:
            batch = replace(batch, steps=None)  # as from a file: not held to the centering in the frame's name
        _require(where, target, batch)
    except ContractError:
        raise
    except PcdataError as error:  # the tensors cannot even be made
        raise ContractError(f"{where}: {error}") from error


def require_depth(where: str, target: Target, frame: DepthFrame) -> None:
    """Refuse one view whose points ``check`` fails, for a loader that makes clouds of depth images.

    Raises:
        ContractError: every rule that failed, with what to do.
    """
    cloud = Deproject()(frame)
    step = -(-cloud.num_points // MANY) or 1
    index = torch.arange(0, cloud.num_points, step, dtype=torch.int64, device="cpu")
    thin = cloud.select(index, ptr_from_counts([len(index)]))
    require_cloud(where, target, thin)


def require_image(where: str, target: Target, frame: DepthFrame) -> None:
    """Refuse one view that ``check`` fails, for a loader that feeds depth images: its window, whole and normalized.

    Raises:
        ContractError: every rule that failed, with what to do.
    """
    window = min(*frame.size, *(contract(target.model).window or frame.size))
    made = preset(target.model, window=window)
    _require(where, target, made.collate([made.pipeline(frame)]))


def _require(where: str, target: Target, batch: ModelBatch) -> None:
    try:
        require(batch, target.model, but=target.left_to_loader)
    except ContractError as error:
        raise ContractError(f"{where}: {error}") from error
