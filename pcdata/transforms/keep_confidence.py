"""Keeping what is to be trusted: KeepConfidence."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.errors import CaptureError
from pcdata.functional.rows import ptr_after_mask
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.families import RemoveTransform
from pcdata.transforms.field_types import ConfidenceName, confidence_named


class KeepConfidence(RemoveTransform):
    """Drop points that are less to be trusted than a level; ``MaskDepth(min_confidence=...)`` does so in the image.

    Args:
        minimum: the least confidence that stays.
    """

    decides_by = "point"

    minimum: ConfidenceName = "reliable"

    def pick(self, cloud: PointCloud, streams: Streams) -> tuple[Tensor, Tensor]:
        """Pick the rows at the level or above."""
        confidence = cloud.extra.get("confidence")
        if confidence is None or confidence.dtype != torch.uint8 or confidence.ndim != 1:
            found = "none" if confidence is None else f"{confidence.dtype} {tuple(confidence.shape)}"
            raise CaptureError(
                "KeepConfidence: needs extra['confidence'], uint8 (N,), the values of Confidence, but the cloud has "
                f"{found}; MarkUnreliableDepth and CompleteDepth set it before Deproject"
            )
        keep = confidence >= confidence_named(self.minimum)
        return keep, ptr_after_mask(keep, cloud.ptr)
