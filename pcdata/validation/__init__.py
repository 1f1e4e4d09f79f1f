"""Judge raw captures, each camera on its own, before anything is made of them."""

from pcdata.validation.check import Check, Verdict
from pcdata.validation.limits import Limits
from pcdata.validation.report import WHOLE, SampleReport, Summary
from pcdata.validation.run import check_of_error, validate_frame, validate_source

__all__ = [
    "WHOLE",
    "Check",
    "Limits",
    "SampleReport",
    "Summary",
    "Verdict",
    "check_of_error",
    "validate_frame",
    "validate_source",
]
