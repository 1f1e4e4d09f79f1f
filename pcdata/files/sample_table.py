"""Tables of facts that no sample holds itself: a CSV or JSON file from sample id to named values."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pcdata.errors import ConfigError
from pcdata.files.opening import read_bytes
from pcdata.files.strict_json import json_object

_MAX_BYTES = 1 << 28


def read_sample_table(where: str, path: str | Path) -> dict[str, Mapping[str, Any]]:
    """Return the row of every sample in a table.

    A CSV file has a header with the column ``sample``; a file ``*.json`` is an object from sample id to an object.

    Raises:
        ConfigError: no such file, or it is damaged, or a sample has no row of named values, or two.
    """
    data = read_bytes(where, path, max_bytes=_MAX_BYTES, error=ConfigError)
    if Path(path).suffix.lower() == ".json":
        found = json_object(f"{where}: {path}", data, error=ConfigError)
        for sample_id, row in found.items():
            if not isinstance(row, dict):
                raise ConfigError(
                    f"{where}: {path}: sample {sample_id!r:.100} must map to an object of names and values, such as "
                    f'{{"object_set": "a"}}, got {row!r:.100}'
                )
        return found
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{where}: {path}: must be UTF-8 text: {error}") from error
    reader = csv.DictReader(text.splitlines(), strict=True)
    rows: dict[str, Mapping[str, Any]] = {}
    try:
        if "sample" not in (reader.fieldnames or ()):
            raise ConfigError(
                f"{where}: {path}: the first line must name the columns, sample among them, got "
                f"{reader.fieldnames!r:.200}"
            )
        for row in reader:
            if row["sample"] in rows:
                raise ConfigError(f"{where}: {path}:{reader.line_num}: sample {row['sample']!r:.100} comes twice")
            rows[row["sample"]] = row
    except csv.Error as error:
        raise ConfigError(f"{where}: {path}:{reader.line_num}: {error}") from error
    return rows
