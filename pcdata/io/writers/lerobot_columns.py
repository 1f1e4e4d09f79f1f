"""Which columns the signals and cameras of captures become in a LeRobot dataset."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.errors import CaptureError, ConfigError, near_matches
from pcdata.io.sources.lerobot_facts import DTYPES, IMAGES, SignalFacts
from pcdata.io.sources.lerobot_files import INDEX_COLUMNS
from pcdata.structures import DepthFrame, Signal
from pcdata.structures.pose_rows import continued, poses_in_a_row

_TASKS = ("task", "instruction", "language_instruction", "language")
_INDEX_DTYPES = {"timestamp": "float32"}
_UNFIT = re.compile(r"[/\s]+")  # LeRobot takes no / in a name


def index_features() -> dict[str, dict[str, Any]]:
    """Return the features that every LeRobot dataset has."""
    return {name: _feature(_INDEX_DTYPES.get(name, "int64"), [1]) for name in INDEX_COLUMNS}


def camera_names(frame: DepthFrame) -> list[str]:
    """Return a name for each view, as its source calls them where it does."""
    cameras = frame.provenance.get("cameras")
    usual = [f"view{view}" for view in range(frame.num_views)]
    names = [*map(str, cameras)] if isinstance(cameras, list) and len(cameras) == frame.num_views else usual
    fit = [_UNFIT.sub("_", name).strip("._") for name in names]
    return fit if len(set(fit)) == len(fit) and all(fit) else usual


def signal_columns(where: str, signals: Mapping[str, Signal]) -> dict[str, SignalFacts]:
    """Return the column of each signal: ``action`` and ``observation.NAME``, texts apart, one of them the task.

    Raises:
        CaptureError: two would have one column, or one has a dtype that cannot be stored.
    """
    texts = [name for name, signal in signals.items() if isinstance(signal.values, tuple)]
    task = next((name for name in _TASKS if name in texts), texts[0] if len(texts) == 1 else None)
    found: dict[str, SignalFacts] = {}
    for name, signal in signals.items():
        if not isinstance(signal.values, Tensor):
            column = None if name == task else f"text.{_UNFIT.sub('_', name)}"
            found[name] = SignalFacts(column, signal.kind)
            continue
        dtype = str(signal.values.dtype).removeprefix("torch.")
        if dtype not in DTYPES or 0 in signal.values.shape:
            raise CaptureError(
                f"{where}: signal {name!r:.100} of {dtype} {tuple(signal.values.shape)} cannot be stored"
            )
        found[name] = SignalFacts(_column_name(name), signal.kind, signal.frame, dtype, tuple(signal.values.shape[1:]))
    columns = [one.column for one in found.values() if one.column is not None]
    if twice := next((one for one in columns if columns.count(one) > 1 or one in INDEX_COLUMNS), None):
        raise CaptureError(f"{where}: two signals would both be the column {twice!r:.100}; rename one")
    return found


def check_alike(sample_id: str, frame: DepthFrame, first_id: str, first: DepthFrame) -> None:
    """Require the cameras and images of the first capture.

    Raises:
        CaptureError: it has others.
    """
    if (frame.num_views, frame.size) != (first.num_views, first.size):
        raise CaptureError(
            f"{sample_id}: has {frame.num_views} views of {frame.size[1]}x{frame.size[0]}, {first_id} has "
            f"{first.num_views} of {first.size[1]}x{first.size[0]}; write these apart (--only, --skip)"
        )
    for name in ("colors", "world_from_camera", *IMAGES):
        has_it, first_has_it = (getattr(one, name) is not None for one in (frame, first))
        if has_it != first_has_it:
            told = f"has {name}, {first_id} has none" if has_it else f"has no {name}, {first_id} has"
            raise CaptureError(f"{sample_id}: {told}; write these apart (--only, --skip)")
    if frame.frame_id != first.frame_id:
        raise CaptureError(
            f"{sample_id}: its poses lead to {frame.frame_id!r}, those of {first_id} to {first.frame_id!r}"
        )
    models = [
        ([(model, len(values)) for model, values in one.lenses], one.is_window) for one in (frame.camera, first.camera)
    ]
    if models[0] != models[1]:
        raise CaptureError(f"{sample_id}: has another lens model than {first_id}; write these apart (--only, --skip)")


def check_same_signals(sample_id: str, frame: DepthFrame, first_id: str, signals: Mapping[str, SignalFacts]) -> None:
    """Require the signals of the first capture.

    Raises:
        CaptureError: it has others.
    """
    found = signal_columns(f"lerobot: {sample_id}", frame.recorded_signals)
    if found != signals:
        unlike = sorted({*found} ^ {*signals}) or [name for name, one in found.items() if signals[name] != one]
        raise CaptureError(
            f"{sample_id}: its signals are not those of {first_id} ({', '.join(unlike)[:200]} differ); a "
            "dataset has the same in every step: write these apart (--only, --skip)"
        )


def signal_features(facts: Mapping[str, SignalFacts]) -> dict[str, dict[str, Any]]:
    """Return the features that signals are, by column."""
    found = {}
    for one in facts.values():
        if one.column is not None:
            found[one.column] = _feature(stored_dtype(one), list(one.shape) or [1])
    return found


def stored_dtype(one: SignalFacts) -> str:
    """Return the dtype of a column: the signal's own, or one that holds all of its numbers."""
    return "string" if one.dtype is None else "float32" if one.dtype == "bfloat16" else one.dtype


def signal_value(one: SignalFacts, signal: Signal) -> Any:
    """Return what the row of one step holds of a signal."""
    if not isinstance(signal.values, Tensor):
        return signal.values[0]
    values = signal.values[0]
    array: NDArray[Any] = (values.float() if values.dtype == torch.bfloat16 else values).numpy()
    return array.reshape(one.shape or (1,))


def named_signals(where: str, option: str, names: Any) -> list[str]:
    """Return the names of signals: a list, or a text with commas in between, as exports take it.

    Raises:
        ConfigError: it is neither.
    """
    found = [*map(str.strip, names.split(","))] if isinstance(names, str) else names
    if not isinstance(found, (list, tuple)) or not all(isinstance(name, str) and name for name in found):
        raise ConfigError(f"{where}: {option} must be signals, NAME,NAME or a list of names, got {names!r:.100}")
    return [*found]


def derived_columns(
    where: str, option: str, column: str, names: Sequence[str], facts: Mapping[str, SignalFacts], poses: str = ""
) -> dict[str, Any] | None:
    """Return the feature that repeats several signals in one row of numbers, as policies take them; poses as stated.

    Raises:
        ConfigError: one is not there, is a text, or there is such a column already.
    """
    if not names:
        return None
    if any(one.column == column for one in facts.values()):
        raise ConfigError(f"{where}: {option}: a signal is the column {column} already; leave the option out")
    width = 0
    for name in names:
        if name not in facts or facts[name].dtype is None:
            hint = near_matches(name, facts) or f"; there are {', '.join(facts) or 'none'}"
            raise ConfigError(f"{where}: {option}: there is no signal of numbers {name!r:.100}{hint}")
        like = torch.zeros(1, *facts[name].shape, dtype=torch.float32, device="cpu")
        width += poses_in_a_row(facts[name].kind, like, poses)[1].numel()
    return _feature("float32", [width])


def derived_value(
    names: Sequence[str],
    signals: Mapping[str, Signal],
    poses: str = "",
    before: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Return several signals in one row of numbers, their poses written as stated.

    With the row of the step before quaternions have the sign nearest to it; those that are written as they were
    recorded keep theirs.
    """
    rows: list[Tensor] = []
    for name in names:
        values = signals[name].values
        if isinstance(values, Tensor):
            kind, row = poses_in_a_row(signals[name].kind, values, poses)
            if poses and before is not None:
                start = sum(map(len, rows))
                row = continued(kind, row, torch.from_numpy(before[start : start + row.numel()]).reshape(row.shape))
            rows.append(row.reshape(-1).float())
    return torch.cat(rows).numpy()


def number_feature(dtype: str, shape: Sequence[int], names: Sequence[str] | None = None) -> dict[str, Any]:
    """Return the feature of a column of numbers."""
    return _feature(dtype, shape, names)


def _feature(dtype: str, shape: Sequence[int], names: Sequence[str] | None = None) -> dict[str, Any]:
    return {"dtype": dtype, "shape": list(shape), "names": None if names is None else list(names)}


def _column_name(name: str) -> str:
    fit = _UNFIT.sub("_", name)
    is_named = fit in ("action", "observation") or fit.startswith(("observation.", "action."))
    return fit if is_named else f"observation.{fit}"
