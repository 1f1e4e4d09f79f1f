"""Write the captures of any source in another layout: all of it, or nothing."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

from pcdata.errors import CacheError, PcdataError, add_note, write_fault
from pcdata.files.whole_folders import complete_or_nothing, is_free
from pcdata.io.sources.capture_source import check_apart, checked_ids, episodes_of, skipped_of, unread_of
from pcdata.io.sources.combine import SubsetSource
from pcdata.io.sources.open_source import open_source
from pcdata.io.writers.registry import writer_named
from pcdata.io.writers.writer import Captures, Writer, WrittenReport
from pcdata.io.writers.writers import WRITERS
from pcdata.progress import Progress

_WHERE = "convert"
_TRIED = 8  # captures in a row that a dry run looks at, and the last


def convert(
    source: Any,
    to: str,
    out: str | os.PathLike[str],
    *,
    progress: Progress | None = None,
    dry_run: bool = False,
    **options: Any,
) -> WrittenReport:
    """Write captures in another layout, which :func:`pcdata.open_source` reads.

    One capture is in memory at a time. The folder appears under its name only when it is complete, and nothing is
    written over.

    Args:
        source: captures, such as :func:`pcdata.open_source` gives; or a path that it opens without options.
        to: the layout, one of :data:`pcdata.io.WRITERS`.
        out: the folder, which is new, and not inside the captures.
        progress: called after every capture.
        dry_run: tell what would be written and lost, by a few captures that are written to a temporary folder and
            removed; nothing appears at ``out``.
        **options: of the layout; see docs/convert.md.

    Returns:
        What was written, what was lost of it, and what was left out.

    Raises:
        ConfigError: no such layout or option, or the folder is inside the captures.
        CacheError: the folder exists, or cannot be written.
        PcdataError: a capture cannot be read, or does not fit the layout.
    """
    writer = writer_named(_WHERE, to, options)
    opened = open_source(source) if isinstance(source, (str, os.PathLike)) else source
    folder = Path(os.path.realpath(Path(out).expanduser()))
    check_apart(_WHERE, folder, opened)
    if not is_free(folder):
        raise CacheError(f"{_WHERE}: {folder} exists already, and nothing is written over; choose a new folder")
    report = WrittenReport(folder, writer.kind, left_out=skipped_of(opened), not_read=unread_of(opened))
    if dry_run:
        return _tried(opened, writer, report, progress)
    captures = Captures(opened, writer.keeps, report, progress)
    report.episodes = len(captures.episodes)
    with complete_or_nothing(folder, note=captures.note) as partial:
        try:
            writer.write(captures, partial)
        except PcdataError as error:
            if error.sample_id is None and captures.latest:
                add_note(error, f"while writing capture {captures.latest!r}", sample_id=captures.latest)
            raise
        except OSError as error:
            raise CacheError(f"{folder}: cannot be written: {write_fault(error)}") from error
        captures.inputs.check(_WHERE)
        report.size = sum(file.stat().st_size for file in partial.rglob("*") if file.is_file())
    return report


def _tried(source: Any, writer: Writer, report: WrittenReport, progress: Progress | None) -> WrittenReport:
    """Return what a report of all captures would say, by the first of them and the last."""
    ids = checked_ids(_WHERE, source)
    some = SubsetSource(source, [*dict.fromkeys([*ids[:_TRIED], ids[-1]])])
    captures = Captures(some, writer.keeps, report, progress)
    with tempfile.TemporaryDirectory(prefix="pcdata-") as scratch:
        try:
            writer.write(captures, Path(scratch))
        except OSError as error:
            raise CacheError(f"{scratch}: cannot be written: {write_fault(error)}") from error
        size = sum(file.stat().st_size for file in Path(scratch).rglob("*") if file.is_file())
    report.looked_at, report.samples, report.episodes = len(some), len(ids), len(episodes_of(source))
    report.size = size * len(ids) // len(some)
    return report


__all__ = ["WRITERS", "convert"]
