"""Judging captures: do they hold what training needs, and do several cameras agree."""

from pcdata.validation.overlap import verify_overlap
from pcdata.validation.overlap_result import CameraOverlap, OverlapLimits, OverlapResult, PairOverlap

__all__ = ["CameraOverlap", "OverlapLimits", "OverlapResult", "PairOverlap", "verify_overlap"]
