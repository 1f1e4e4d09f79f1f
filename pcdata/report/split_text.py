"""Splits in words."""

from __future__ import annotations

from pcdata.datasets.leak_check import LeakReport
from pcdata.datasets.splits import Splits
from pcdata.files.sample_names import counted
from pcdata.report.plain_table import text_table

_SHOWN = 20  # pairs, in a summary


def splits_text(splits: Splits) -> str:
    """Tell how many groups and samples every split has, and how they were drawn."""
    samples = {name: len(splits.ids(name)) for name in splits.names}
    total = max(1, sum(samples.values()))
    rows = [[name, len(splits.groups[name]), count, f"{count / total:.1%}"] for name, count in samples.items()]
    told = ", ".join(f"{name} {_plain(value)}" for name, value in splits.settings.items() if value not in ([], None))
    table = text_table(["split", "groups", "samples", "of all"], rows)
    absent = f"\n\n{len(splits.absent)} samples of earlier builds keep their split for when they come back"
    return f"{table}\n\n{told}{absent if splits.absent else ''}"


def splits_in_words(splits: Splits) -> str:
    """Tell the samples of every split in a line."""
    return ", ".join(f"{name} {len(splits.ids(name)):,}" for name in splits.names)


def leaks_text(report: LeakReport) -> str:
    """Tell what is in two splits, with numbers and what to do."""
    small = f"; too few points to be compared: {counted(len(report.too_small), 'cloud')}" if report.too_small else ""
    found, among = counted(len(report.leaks), "near duplicate"), counted(report.num_samples, "sample")
    head = f"leaks    {found} across splits among {among}{small}"
    rows = [
        [f"{one.first} ({one.splits[0]})", f"{one.second} ({one.splits[1]})", f"{one.distance:.3g} {report.unit}"]
        for one in report.leaks[:_SHOWN]
    ]
    more = len(report.leaks) - len(rows)
    lines = [head]
    lines += [f"  {first} shows the same as {second}: {apart} apart" for first, second, apart in rows]
    lines += [f"  and {more} more"] if more > 0 else []
    lines += [f"  episode {name} is in {' and '.join(splits)}" for name, splits in report.episodes.items()]
    if not report.is_clean:
        lines.append(
            "  -> keep such samples together: give both the same value in a column of a table, and draw anew with --by "
            "column:NAME --table FILE --fresh; or leave copies out of the build with --skip ID"
        )
    return "\n".join(lines)


def _plain(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name}={'rest' if much is None else much}" for name, much in value.items())
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
