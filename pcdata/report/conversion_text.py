"""What a conversion wrote, in words."""

from __future__ import annotations

import shlex

from pcdata.io import WrittenReport
from pcdata.report.inspection_text import size_in_words, skipped_text

_SHOWN = 8  # lines of what is not read


def conversion_text(report: WrittenReport) -> str:
    """Tell what was written, what was lost of it, what was left out, and how to go on."""
    episodes = f" in {report.episodes} episode{'s' * (report.episodes != 1)}" if report.episodes else ""
    captures = f"{report.samples} capture{'s' * (report.samples != 1)}{episodes}, {size_in_words(report.size)}"
    lines = [f"written  {report.folder}  ({report.kind}: {captures})"]
    if report.looked_at is not None:
        captures = captures.replace(", ", ", about ", 1)
        lines = [
            f"dry run  nothing is written; {report.folder} would hold ({report.kind}: {captures}), by "
            f"{report.looked_at} captures that were looked at"
        ]
    lines.append(f"streams  {', '.join(report.streams)}")
    lines += [f"lost     {name}: {loss}" for name, loss in report.lost.items()]
    if not report.lost:
        lines.append("lost     nothing: all that was read comes back as it was")
    lines += [f"not read {line}" for line in report.not_read[:_SHOWN]]
    if len(report.not_read) > _SHOWN:
        lines.append(f"not read and {len(report.not_read) - _SHOWN} more; 'pcdata inspect' of the captures tells all")
    lines += [f"note     {note}" for note in report.notes]
    if report.left_out:
        lines.append(skipped_text(report.left_out))
    if report.looked_at is None:
        lines.append(f"next     pcdata inspect {shlex.quote(str(report.folder))}")
    else:
        lines.append("next     the same command without --dry-run")
    return "\n".join(lines)
