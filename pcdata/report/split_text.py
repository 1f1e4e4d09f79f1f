"""Splits in words."""

from __future__ import annotations

from pcdata.datasets.splits import Splits
from pcdata.report.plain_table import text_table


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


def _plain(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name}={'rest' if much is None else much}" for name, much in value.items())
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
