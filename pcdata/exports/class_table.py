"""Facts of samples that no cloud holds: their class and their split, from a file or a mapping."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pcdata.errors import ConfigError, near_matches
from pcdata.exports.copies import original_of
from pcdata.files.sample_table import read_sample_table

Given = Path | Mapping[str, Any]

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


@dataclass(frozen=True)
class Row:
    """What is known of one sample; None = the table has no such column."""

    class_name: str | None
    split: str | None


def read_table(where: str, given: Given | None, ids: Sequence[str], *, needs: Sequence[str]) -> dict[str, Row]:
    """Return the row of every sample id.

    A CSV file has a header ``sample,class,split`` (in any order; which columns must be there, the target says); a JSON
    file or a mapping goes from sample id to ``{"class": ..., "split": ...}``. A copy of a sample has the row of that
    sample, unless it has its own. Rows of other samples do not matter.

    Raises:
        ConfigError: nothing was given, a sample or a column is missing, or a name cannot become a file name.
    """
    columns = ",".join(["sample", *needs])
    if given is None:
        raise ConfigError(
            f"{where}: needs the option table, a CSV file with the header {columns} and a row for each of the "
            f"{len(ids)} samples (or a JSON file, in Python a mapping, from sample id)"
        )
    rows = dict(given) if isinstance(given, Mapping) else read_sample_table(where, given)
    known: dict[str, Row] = {}
    for sample_id in ids:
        original = original_of(sample_id, rows)
        if original not in rows:
            raise ConfigError(f"{where}: the table has no row for sample {sample_id!r}{near_matches(sample_id, rows)}")
        row = rows[original]
        if not isinstance(row, Mapping):
            raise ConfigError(
                f"{where}: sample {sample_id!r} must map to {{'class': ..., 'split': ...}}, got {row!r:.100}"
            )
        values = {column: _name(where, sample_id, column, row.get(column)) for column in ("class", "split")}
        for column in needs:
            if values[column] is None:
                raise ConfigError(
                    f"{where}: the table has no {column} for sample {sample_id!r}; add the column {column}"
                )
        known[sample_id] = Row(values["class"], values["split"])
    return known


def with_splits(where: str, given: Given | None, part_of: Mapping[str, str]) -> dict[str, Mapping[str, Any]]:
    """Return a table with the splits of a dataset, where the table itself names none.

    Args:
        where: the target.
        given: the table; None = there is none.
        part_of: split of every sample, or of every episode where the rows are of those.
    """
    rows = dict(given) if isinstance(given, Mapping) else {} if given is None else read_sample_table(where, given)
    for name, split in part_of.items():
        row = rows.get(name, {})
        if isinstance(row, Mapping) and not row.get("split") and (name in rows or given is None):
            rows[name] = {**row, "split": split}
    return rows


def _name(where: str, sample_id: str, column: str, value: Any) -> str | None:
    if value is None or value == "":
        return None
    if not isinstance(value, str) or not _NAME.fullmatch(value):
        raise ConfigError(
            f"{where}: the {column} of sample {sample_id!r} must be of letters, digits, '_', '-' and '.', since it "
            f"becomes a file name, got {value!r:.100}"
        )
    return value


def in_splits(where: str, rows: Mapping[str, Row], allowed: Sequence[str]) -> dict[str, list[str]]:
    """Return the sample ids of each split in their order; without a split a sample is in the first.

    Raises:
        ConfigError: a split that the loader does not know.
    """
    splits: dict[str, list[str]] = {name: [] for name in allowed}
    for sample_id, row in rows.items():
        split = row.split or allowed[0]
        if split not in splits:
            raise ConfigError(
                f"{where}: sample {sample_id!r} is in split {split!r}, but the loader has {', '.join(allowed)}; "
                "name the splits so (pcdata split --fresh --parts), or give the column split"
            )
        splits[split].append(sample_id)
    return splits


def classes_of(rows: Mapping[str, Row]) -> list[str]:
    """Return the class names in alphabetical order, which numbers them."""
    return sorted({row.class_name for row in rows.values() if row.class_name is not None})
