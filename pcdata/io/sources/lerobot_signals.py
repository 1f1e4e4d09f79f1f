"""The signals of a LeRobot dataset: its columns of numbers and texts, and the task."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from pcdata.errors import CaptureError
from pcdata.io.sources.lerobot_cameras import is_number
from pcdata.io.sources.lerobot_facts import DTYPES, DatasetFacts, SignalFacts
from pcdata.io.sources.lerobot_files import INDEX_COLUMNS
from pcdata.io.sources.lerobot_index import LeRobotIndex, RecordedEpisode
from pcdata.io.sources.stated_kinds import check_stated_names, kind_of, signal_of
from pcdata.structures import Signal

_TASK = "task"
_LANGUAGE = ("language_persistent", "language_events")
_MOST_NUMBERS = 1 << 14  # of a signal: more are an image or a cloud


def signal_columns(
    where: str, index: LeRobotIndex, facts: DatasetFacts | None, used: Collection[str], stated: Mapping[str, Any]
) -> dict[str, SignalFacts]:
    """Return the signals by name: as the dataset's own facts say, else every column that is nothing else.

    Args:
        where: for messages.
        index: of the dataset.
        facts: its own, where pcdata wrote it.
        used: columns that are no signals.
        stated: kinds and frames by name.

    Raises:
        ConfigError: a kind is stated of what is no signal.
    """
    if facts is not None:
        known = dict(facts.signals)
    else:
        known = {}
        for key, said in index.features.items():
            if key in INDEX_COLUMNS or key in used or key in _LANGUAGE:
                continue
            if str(said.get("dtype")) == "string":
                known[key] = SignalFacts(key, "text")
            elif is_number(said) and _numbers(said) <= _MOST_NUMBERS:
                known[key] = SignalFacts(key, "invariant", None, str(said["dtype"]), tuple(_shape(said)))
        if index.episodes[0].tasks and _TASK not in known:
            known[_TASK] = SignalFacts(None, "text")
    check_stated_names(where, stated, known)
    found = {}
    for name, one in known.items():
        kind = kind_of(name, stated, (one.kind, one.frame))
        if kind is not None:
            found[name] = replace(one, kind=kind[0], frame=kind[1])
    return found


def signals_of(
    where: str, columns: Mapping[str, SignalFacts], episode: RecordedEpisode, step: int, row: Mapping[str, Any]
) -> dict[str, Signal]:
    """Return the signals of a step from its row.

    Raises:
        CaptureError: a value is not of its kind.
    """
    found = {}
    for name, one in columns.items():
        values: Any
        if one.dtype is None:
            text = row[one.column] if one.column is not None else episode.tasks[step]
            if not isinstance(text, str):
                raise CaptureError(f"{where}: column {one.column!r} must hold texts, got {type(text).__name__}")
            values = (text,)
        else:
            values = _tensor(f"{where}: column {one.column!r}", row[str(one.column)], one)
        found[name] = signal_of(where, name, values, (one.kind, one.frame))
    return found


def _tensor(where: str, values: Any, one: SignalFacts) -> torch.Tensor:
    count = int(np.prod(one.shape, dtype=np.int64))
    if not isinstance(values, np.ndarray) or values.size != count:
        found = f"{values.size} numbers" if isinstance(values, np.ndarray) else type(values).__name__
        raise CaptureError(f"{where}: must hold {list(one.shape)} numbers as its feature says, got {found}")
    # torch has no unsigned integers above 8 bits to compute with: the next wider signed ones hold them all.
    wider = {"uint16": "int32", "uint32": "int64", "uint64": "int64"}.get(values.dtype.name)
    if values.dtype == np.uint64 and values.size and values.max() >= 1 << 63:
        raise CaptureError(f"{where}: holds {values.max()}, above what int64 holds")
    tensor = torch.from_numpy(np.array(values if wider is None else values.astype(wider)))
    wanted = DTYPES.get(str(one.dtype), tensor.dtype)
    return tensor.to(wanted).reshape(1, *one.shape)


def _shape(said: Mapping[str, Any]) -> list[int]:
    shape = said.get("shape", [1])
    return list(shape) if isinstance(shape, list) else [shape]


def _numbers(said: Mapping[str, Any]) -> int:
    return int(np.prod(_shape(said), dtype=np.float64))
