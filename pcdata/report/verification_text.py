"""What the verification of a dataset found, in words."""

from __future__ import annotations

from pcdata.build.verification import DatasetFault, DatasetVerdict
from pcdata.files.sample_names import counted
from pcdata.report.plain_table import text_table

_SHOWN = 5  # samples of a file


def verification_text(verdict: DatasetVerdict) -> str:
    """Tell every fault, the samples that it spoils, and what to do."""
    looked = f"{verdict.folder}: hashed {counted(verdict.num_files, 'file')} of {verdict.num_bytes:,} bytes"
    notes = [f"note: {text}" for text in verdict.notes]
    if not verdict.faults:
        return "\n".join([f"{looked}; all are what was written", *notes])
    rows = [[fault.kind, fault.path, fault.why, _samples(fault)] for fault in verdict.faults]
    spoiled = len({sample for fault in verdict.faults for sample in fault.samples})
    bad = any(fault.kind != "foreign" for fault in verdict.faults)
    return "\n".join(
        [
            f"{looked}; not what was written: {len(verdict.faults)}, which spoils {counted(spoiled, 'sample')}",
            "",
            text_table(["what", "file", "why", "samples"], rows),
            *(["", "copy the damaged and missing files again, or build the dataset again"] if bad else []),
            *notes,
        ]
    )


def _samples(fault: DatasetFault) -> str:
    more = f", and {len(fault.samples) - _SHOWN} more" if len(fault.samples) > _SHOWN else ""
    return ", ".join(fault.samples[:_SHOWN]) + more if fault.samples else "none"
