"""The signals of one moment as a JSON file that a person can read and write.

``{"eef": {"kind": "pose xyz_quat_xyzw", "frame": "base", "values": [...]}, "task": {"kind": "text", "values": "..."}}``
says a pose and a text; ``dtype`` is "float32" where it is not stated. Numbers come back bit for bit.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pcdata.errors import CaptureError, locates_path, near_matches
from pcdata.files.opening import read_text, replacing
from pcdata.files.strict_json import json_object
from pcdata.structures import Signal
from pcdata.structures.signals import checked_signal

_DTYPES = {
    str(dtype).removeprefix("torch."): dtype
    for dtype in (
        torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.uint8, torch.int8, torch.int16, torch.int32,
        torch.int64, torch.bool,
    )
}  # fmt: skip
_KEYS = ("kind", "frame", "dtype", "values")


@locates_path
def read_signals(path: str | os.PathLike[str]) -> dict[str, Signal]:
    """Read the signals of one moment, each with a leading 1.

    Raises:
        CaptureError: the file is missing, no JSON object, or what it says is no signal.
    """
    where = f"read_signals: {path}"
    signals = {}
    for name, said in json_object(where, read_text(where, path), error=CaptureError).items():
        of = f"{where}: {name!r:.100}"
        if not isinstance(said, dict) or (unknown := sorted(said.keys() - {*_KEYS})):
            wrong = (
                "" if not isinstance(said, dict) else f", and no {unknown[0]!r:.60}{near_matches(unknown[0], _KEYS)}"
            )
            raise CaptureError(f"{of}: must be an object with kind, values and maybe frame and dtype{wrong}")
        values = _values(of, said.get("values"), said.get("dtype"))
        try:
            signals[name] = checked_signal(of, name, values, said.get("kind", ""), said.get("frame"))
        except (ValueError, TypeError) as error:
            told = str(error)
            raise CaptureError(told if told.startswith(of) else f"{of}: {told}") from error
    return signals


@locates_path
def write_signals(path: str | os.PathLike[str], signals: Mapping[str, Signal]) -> None:
    """Write the signals of one moment (B = 1) for :func:`read_signals`.

    Raises:
        CaptureError: a dtype that JSON cannot say.
    """
    where = f"write_signals: {path}"
    told: dict[str, Any] = {}
    for name, signal in signals.items():
        told[name] = {"kind": signal.kind} if signal.frame is None else {"kind": signal.kind, "frame": signal.frame}
        if not isinstance(signal.values, Tensor):
            told[name]["values"] = signal.values[0]
            continue
        dtype = str(signal.values.dtype).removeprefix("torch.")
        if dtype not in _DTYPES:
            raise CaptureError(f"{where}: signal {name!r}: {dtype} cannot be written; convert it, e.g. to float32")
        told[name] |= {"dtype": dtype, "values": signal.values[0].tolist()}
    lines = [f" {json.dumps(name)}: {json.dumps(said, allow_nan=False)}" for name, said in told.items()]
    with replacing(where, path) as temporary:
        Path(temporary).write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def _values(where: str, values: Any, dtype: Any) -> Tensor | tuple[str, ...]:
    if isinstance(values, str):
        return (values,)
    if not isinstance(dtype, str | None) or dtype not in (None, *_DTYPES):
        raise CaptureError(f"{where}: dtype must be one of {', '.join(_DTYPES)}, got {dtype!r:.60}")
    kind = _DTYPES[dtype or "float32"]
    if not _plain(values, bool if kind is torch.bool else int if not kind.is_floating_point else (int, float)):
        raise CaptureError(f"{where}: values must be {dtype or 'float32'} numbers, or lists of them, or a text")
    if kind is torch.uint8 and _lowest(values) < 0:  # torch would count such a one from 256 down
        raise CaptureError(f"{where}: values are no array of uint8: {_lowest(values)} is below 0")
    try:
        return torch.tensor([values], dtype=kind, device="cpu")
    except (ValueError, OverflowError, RuntimeError, TypeError) as error:
        raise CaptureError(f"{where}: values are no array of {dtype or 'float32'}: {str(error)[:200]}") from error


def _lowest(values: Any) -> Any:
    return min(map(_lowest, values), default=0) if isinstance(values, list) else values


def _plain(values: Any, number: type | tuple[type, ...]) -> bool:
    if isinstance(values, list):
        return all(_plain(one, number) for one in values)
    return isinstance(values, number) and (number is bool or not isinstance(values, bool))
