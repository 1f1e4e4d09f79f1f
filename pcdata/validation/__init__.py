"""Judging captures: do they hold what training needs, and do several cameras agree."""

from pcdata.validation.capture_check import CHECKS, Check, register_check
from pcdata.validation.capture_limits import CaptureLimits
from pcdata.validation.comparison import Comparison, Difference, Measured, compare_sources
from pcdata.validation.drift import measure_drift
from pcdata.validation.drift_result import CameraDrift, DriftLimits, DriftPoint, DriftResult
from pcdata.validation.grading import Grade, Grading
from pcdata.validation.overlap import verify_overlap
from pcdata.validation.overlap_result import CameraOverlap, OverlapLimits, OverlapResult, PairOverlap
from pcdata.validation.run import check_of_error, validate_frame, validate_source
from pcdata.validation.segmentation import ObjectScore, SegmentationScores, mean_scores, score_segmentation
from pcdata.validation.summary import WHOLE, SampleReport, Summary

__all__ = [
    "CHECKS",
    "WHOLE",
    "CameraDrift",
    "CameraOverlap",
    "CaptureLimits",
    "Check",
    "Comparison",
    "Difference",
    "DriftLimits",
    "DriftPoint",
    "DriftResult",
    "Grade",
    "Grading",
    "Measured",
    "ObjectScore",
    "OverlapLimits",
    "OverlapResult",
    "PairOverlap",
    "SampleReport",
    "SegmentationScores",
    "Summary",
    "check_of_error",
    "compare_sources",
    "mean_scores",
    "measure_drift",
    "register_check",
    "score_segmentation",
    "validate_frame",
    "validate_source",
    "verify_overlap",
]
