"""What RLBench and M2T2 record of the robot at every step, from JSON or from a pickle of arrays.

Source: RLBench, ``backend/observation.py`` (attributes), ``backend/scene.py`` (``_get_misc``: cameras); PyRep,
``Object.get_pose`` (x y z, quaternion x y z w) and ``get_matrix``; M2T2, meta_data (one list for each attribute).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pcdata.errors import CaptureError
from pcdata.files.opening import read_bytes
from pcdata.io.arrays.plain_pickles import read_plain_pickle
from pcdata.io.sources.stated_kinds import check_stated_names, kind_of, signal_of, stated_kinds
from pcdata.structures import Signal

PICKLES = ("meta_data.pkl", "low_dim_obs.pkl")
_MAX_BYTES = 1 << 27
_MAX_NUMBERS = 1 << 16  # of one step: the low-dimensional state of a task has some hundreds
_SPATIAL = {"gripper_matrix": "pose matrix", "gripper_pose": "pose xyz_quat_xyzw"}
_TEXTS = {"goal_description": "task"}
_OF_DEMO = ("random_seed", "num_reset_attempts", "variation_number", "instructions")


def read_rlbench_pickle(path: Path, allowed: Sequence[Path]) -> dict[str, Any]:
    """Return the metadata of an episode as the JSON file holds them: a list with an entry for each step, by attribute.

    Raises:
        CaptureError: it holds anything but arrays, numbers, texts and RLBench's observations; nothing is run.
    """
    where = f"rlbench source {path}"
    said = read_plain_pickle(where, read_bytes(where, path, max_bytes=_MAX_BYTES, inside=allowed))
    observations = said.get("_observations") if isinstance(said, dict) else said
    if isinstance(said, dict) and observations is None:
        return {name: _as_lists(value) for name, value in said.items() if isinstance(name, str)}
    if not isinstance(observations, list) or not observations or not all(isinstance(one, dict) for one in observations):
        raise CaptureError(f"{where}: must hold metadata by name, or a demonstration's observations")
    return _by_attribute(observations)


def rlbench_signals(
    where: str, said: Mapping[str, Any], steps: Sequence[int], stated: Mapping[str, Any] | None, frame_id: str
) -> dict[int, dict[str, Signal]]:
    """Return the signals of some steps: what has numbers for every step, but for what is said of cameras.

    Raises:
        CaptureError: values are not of their kind.
        ConfigError, FrameError: what is stated is no kind, or of what is not there.
    """
    most = max(steps, default=0)
    found = {
        name: values
        for name, value in said.items()
        if "_camera_" not in name and (values := _numbers(value)) is not None and len(values) > most
    }
    texts = {own: said[name] for name, own in _TEXTS.items() if isinstance(said.get(name), str) and said[name]}
    kinds = stated_kinds(where, stated)
    check_stated_names(where, kinds, {*found, *texts})
    signals: dict[int, dict[str, Signal]] = {step: {} for step in steps}
    for name, values in found.items():
        known = (_SPATIAL[name], frame_id) if name in _SPATIAL else None
        kind = kind_of(name, kinds, known)
        for step in steps if kind is not None else ():
            assert kind is not None
            signals[step][name] = signal_of(f"{where}: step {step}", name, values[step][None], kind)
    for name, text in texts.items():
        for step in steps if kinds.get(name, ()) is not None else ():
            signals[step][name] = signal_of(where, name, (text,), ("text", None))
    return signals


def _by_attribute(observations: list[dict[str, Any]]) -> dict[str, Any]:
    """Turn observations, each with its cameras in ``misc``, into lists by attribute; lenses are of the first."""
    first = observations[0]
    misc = [one.get("misc") for one in observations]
    cameras = {str(name) for one in misc if isinstance(one, dict) for name in one if "_camera_" in str(name)}
    found: dict[str, Any] = {}
    for name in sorted(cameras):
        values = [_as_lists(one[name]) if isinstance(one, dict) and name in one else None for one in misc]
        found[name] = values if name.endswith("_extrinsics") else values[0]
    for name in first:
        if isinstance(name, str) and name != "misc" and name not in _OF_DEMO:
            values = [_as_lists(one.get(name)) for one in observations]
            if all(value is not None for value in values):
                found[name] = values
    return found


def _as_lists(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [_as_lists(one) for one in value] if isinstance(value, list) else value


def _numbers(value: Any) -> Tensor | None:  # (steps, ...) float64
    """Return numbers of every step; None where they are none, or of other shapes from step to step."""
    if not isinstance(value, list) or not value:
        return None
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    if array.size > len(value) * _MAX_NUMBERS or not np.isfinite(array).all():
        return None
    return torch.from_numpy(array)
