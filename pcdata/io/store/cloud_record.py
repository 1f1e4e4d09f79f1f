"""A cloud as named arrays and one JSON text: the form that every file format stores.

Arrays follow the field's customs, so that other tools can read them: ``points``, ``colors`` and ``normals`` are (N, 3)
float32, colors in [0, 1], and ``labels`` is (N, 1) int32; compact, ``colors`` are bytes and ``normals`` (N, 2) int16.
``intrinsics`` (V, 3, 3) and ``extrinsics`` (V, 4, 4) world_from_camera repeat what the JSON says of the cameras.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
import torch
from torch import Tensor

from pcdata.errors import CacheError, PcdataError
from pcdata.files.strict_json import json_object, parse_json
from pcdata.io.store.compact_fields import compacted, expanded
from pcdata.structures import PointCloud, Signal
from pcdata.structures.kinds import FIELDS
from pcdata.structures.read_later import StoredMeta, StoredSteps
from pcdata.structures.signals import checked_signal

SCHEMA = "pcdata.cloud/1"
SIGNALS_SCHEMA = "pcdata.signals/1"

_CLOUD_FIELDS = ("ptr", "source_from_cloud", "viewpoint")
_BFLOAT16 = "bfloat16"
EXTRA, FRAMES, SIGNALS = "extra.", "frames.", "signals."
DERIVED = ("intrinsics", "extrinsics")  # repeat the facts, for other tools


# Memory of so many bytes, (bytes,) uint8, for the arrays of a record; None where there is none.
Room = Callable[[int], Tensor | None]


@dataclass(frozen=True)
class Record:
    """Arrays by name, and JSON-able facts."""

    arrays: Mapping[str, np.ndarray]
    info: Mapping[str, Any]
    form: Any = None  # the same for records that differ in the rows, the meta and the history alone; None = unknown
    # By name (B,) int64 addresses where the rows of each cloud lie, while the store is open: the arrays of these names
    # are room for them alone.
    sources: Mapping[str, np.ndarray] | None = None

    def info_text(self) -> str:
        """The facts as canonical JSON."""
        return json.dumps(self.info, sort_keys=True, separators=(",", ":"), allow_nan=False)

    def digest(self) -> str:
        """SHA-256 over names, dtypes, shapes and bytes of all arrays and over the facts.

        Raises:
            CacheError: the facts hold a number that JSON does not have.
        """
        try:
            total = hashlib.sha256(self.info_text().encode())
        except (ValueError, RecursionError) as error:
            raise CacheError(f"the JSON part cannot be written again: {error}") from error
        for name in sorted(self.arrays):
            array = np.ascontiguousarray(self.arrays[name])
            total.update(f"\0{name}\0{array.dtype.str}\0{array.shape}\0".encode())
            total.update(array.data if array.size else b"")
        return total.hexdigest()


def record_from_cloud(cloud: PointCloud, *, compact: bool = False) -> Record:
    """Write a cloud, or a batch, as a record; everything it knows is kept.

    ``compact`` stores colors and normals as :mod:`pcdata.io.store.compact_fields` says, with errors within its bounds.

    Raises:
        CacheError: a label does not fit into int32, a dtype has no NumPy counterpart, or meta or history hold what JSON
            cannot.
    """
    cloud = cloud if cloud.device.type == "cpu" else cloud.cpu()
    arrays = {name: _array(name, value) for name in FIELDS if (value := getattr(cloud, name)) is not None}
    if cloud.labels is not None:
        arrays["labels"] = _labels_as_int32(arrays["labels"])
    arrays |= {EXTRA + name: _array(name, value) for name, value in cloud.extra.items()}
    # Frames may be called "robot/base_link", and a slash would open a group in HDF5.
    frames = _array_names(FRAMES, cloud.frames)
    arrays |= {frames[name]: _array(name, matrix) for name, matrix in cloud.frames.items()}
    arrays |= {"ptr": cloud.ptr.numpy(), "source_from_cloud": _array("source_from_cloud", cloud.source_from_cloud)}
    if cloud.viewpoint is not None:
        arrays["viewpoint"] = _array("viewpoint", cloud.viewpoint)
    arrays |= _camera_arrays(cloud)
    arrays |= _signal_arrays(cloud.recorded_signals)
    info: dict[str, Any] = {
        "schema": SCHEMA,
        "frame_id": cloud.frame_id,
        "source_frame": cloud.source_frame,
        "unit": cloud.unit,
        "kinds": {name: kind.value for name, kind in cloud.kinds.items()},
        "meta": list(cloud.meta),
        "history": [list(steps) for steps in cloud.history],
    }
    if cloud.recorded_signals:
        info["signals"] = [_told(name, signal) for name, signal in cloud.recorded_signals.items()]
    return Record(compacted(arrays) if compact else arrays, _as_json(info))


def cloud_from_record(record: Record) -> PointCloud:
    """Read a record back as the cloud it was written from.

    Raises:
        CacheError: the record is not one, or its parts do not fit together.
    """
    info = record.info
    if not isinstance(info, Mapping) or info.get("schema") != SCHEMA:
        schema = info.get("schema") if isinstance(info, Mapping) else info
        raise CacheError(f"not a cloud record: schema must be {SCHEMA!r}, got {schema!r}")
    _check_info(info)
    tensors = {name: _tensor(name, array) for name, array in record.arrays.items() if name not in DERIVED}
    tensors = expanded(tensors)
    extra = {name.removeprefix(EXTRA): tensors.pop(name) for name in list(tensors) if name.startswith(EXTRA)}
    frames = {
        unquote(name.removeprefix(FRAMES)): tensors.pop(name) for name in list(tensors) if name.startswith(FRAMES)
    }
    recorded = {
        unquote(name.removeprefix(SIGNALS)): tensors.pop(name) for name in list(tensors) if name.startswith(SIGNALS)
    }
    if len(frames) + len(recorded) != sum(name.startswith((FRAMES, SIGNALS)) for name in record.arrays):
        raise CacheError("two arrays are of one frame or signal, written differently")
    unknown = tensors.keys() - {*FIELDS, *_CLOUD_FIELDS}
    if unknown:
        raise CacheError(f"no cloud has the arrays {sorted(unknown)}")
    if any(matrix.dtype != torch.float64 for matrix in frames.values()):
        raise CacheError(f"frames must be float64, got {[str(matrix.dtype) for matrix in frames.values()]}")
    if "labels" in tensors:
        labels = tensors["labels"]
        if labels.dtype != torch.int32 or labels.shape[1:] != (1,):
            raise CacheError(f"labels must be int32 (N, 1), got {labels.dtype} {tuple(labels.shape)}")
        tensors["labels"] = labels[:, 0].long()
    try:
        return PointCloud(
            **tensors,  # type: ignore[arg-type]  # names were checked above
            extra=extra,
            frames=frames,
            frame_id=info["frame_id"],
            source_frame=info["source_frame"],
            unit=info["unit"],
            kinds=info["kinds"],
            meta=info["meta"],
            history=info["history"],
            recorded_signals=_signals(info.get("signals", []), recorded),
        )
    except (PcdataError, TypeError, ValueError, KeyError) as error:
        raise CacheError(f"the record's parts do not fit together: {error}") from error


def record_from_signals(signals: Mapping[str, Signal]) -> Record:
    """Write the signals of many samples, (S, ...) each, as one record.

    Raises:
        CacheError: a dtype has no NumPy counterpart.
    """
    arrays = _signal_arrays(signals)
    info = {"schema": SIGNALS_SCHEMA, "signals": [_told(name, signal) for name, signal in signals.items()]}
    # Stores show these of every record.
    return Record(arrays, _as_json({**info, "frame_id": "", "unit": ""}))


def signals_from_record(record: Record, num_samples: int) -> dict[str, Signal]:
    """Read the signals of many samples back.

    Raises:
        CacheError: the record is not one, or not of so many samples.
    """
    info = record.info
    if info.get("schema") != SIGNALS_SCHEMA:
        raise CacheError(f"not a record of signals: schema must be {SIGNALS_SCHEMA!r}, got {info.get('schema')!r:.100}")
    if unknown := [name for name in record.arrays if not name.startswith(SIGNALS)]:
        raise CacheError(f"a record of signals has no arrays {unknown}")
    tensors = {unquote(name.removeprefix(SIGNALS)): _tensor(name, array) for name, array in record.arrays.items()}
    try:
        signals = _signals(info.get("signals"), tensors)
    except (PcdataError, TypeError, ValueError) as error:
        raise CacheError(f"its signals are none: {error}") from error
    if lengths := {len(signal) for signal in signals.values()} - {num_samples}:
        raise CacheError(f"it has signals of {lengths.pop()} samples, but the dataset has {num_samples}")
    return signals


def parse_info(text: str | bytes) -> dict[str, Any]:
    """Parse the facts of a record or manifest; it takes at most about 30 times the memory of the text.

    Raises:
        CacheError: not a JSON object, as :func:`pcdata.files.strict_json.parse_json` takes them.
    """
    return json_object("the JSON part", text, error=CacheError)


def _as_json(info: dict[str, Any]) -> dict[str, Any]:
    """Return the facts as JSON gives them back, so that what is read has the digest of what was written."""
    try:
        plain: dict[str, Any] = parse_json(json.dumps(info, allow_nan=False))
    except (TypeError, ValueError, RecursionError) as error:
        raise CacheError(
            f"meta and history must hold plain finite numbers, texts, lists and dicts to be stored: {error}; convert "
            "tensors with .tolist(), and leave out NaN"
        ) from error
    return plain


def _check_info(info: Mapping[str, Any]) -> None:
    for name in ("frame_id", "source_frame", "unit"):
        if not isinstance(info.get(name), str):
            raise CacheError(f"{name} must be a text, got {info.get(name)!r:.100}")
    if not isinstance(info.get("kinds"), dict):
        raise CacheError(f"kinds must be an object, got {info.get('kinds')!r:.100}")
    for name, kind, unread in (("meta", dict, StoredMeta), ("history", list, StoredSteps)):
        entries = info.get(name)
        if isinstance(entries, unread):
            continue
        if not isinstance(entries, list) or not all(isinstance(entry, kind) for entry in entries):
            raise CacheError(f"{name} must be a list with one {kind.__name__} per cloud, got {entries!r:.100}")


def _signal_arrays(signals: Mapping[str, Signal]) -> dict[str, np.ndarray]:
    names = _array_names(SIGNALS, signals)
    return {
        names[name]: _array(f"signal {name!r}", _bits(signal.values))
        for name, signal in signals.items()
        if isinstance(signal.values, Tensor)
    }


def _bits(values: Tensor) -> Tensor:
    """Return values as NumPy knows them: of bfloat16, which it does not, the bits."""
    return values.detach().view(torch.int16) if values.dtype is torch.bfloat16 else values


def _array_names(prefix: str, names: Iterable[str]) -> dict[str, str]:
    """Return the names of arrays; archives take those for one that differ by case alone, as joints Q and q."""
    found, taken = {}, set[str]()
    for name in names:
        quoted = quote(name, safe="")
        if quoted.casefold() in taken:
            quoted = "".join(f"%{byte:02X}" for byte in name.encode())
        taken.add(quoted.casefold())
        found[name] = prefix + quoted
    return found


def _told(name: str, signal: Signal) -> dict[str, Any]:
    """Return what the facts say of a signal: a list keeps the order, and texts are no array."""
    told = {"name": name, "kind": signal.kind, "frame": signal.frame}
    if not isinstance(signal.values, Tensor):
        return {**told, "texts": list(signal.values)}
    return {**told, "dtype": _BFLOAT16} if signal.values.dtype is torch.bfloat16 else told


def _bfloat16(where: str, dtype: Any, values: Any) -> Tensor:
    """Return numbers whose bits were stored."""
    if dtype != _BFLOAT16 or not isinstance(values, Tensor) or values.dtype is not torch.int16:
        found = values.dtype if isinstance(values, Tensor) else "texts"
        raise CacheError(f"{where}: dtype must be {_BFLOAT16!r}, whose bits are int16, got {dtype!r:.60} and {found}")
    return values.view(torch.bfloat16)


def _signals(told: Any, arrays: dict[str, Tensor]) -> dict[str, Signal]:
    """Put the signals together again; whatever a file says of them is held to the rules of attaching one."""
    if not isinstance(told, list) or not all(isinstance(entry, dict) for entry in told):
        raise CacheError(f"signals must be a list of objects, got {told!r:.100}")
    signals: dict[str, Signal] = {}
    for entry in told:
        name, texts = entry.get("name"), entry.get("texts")
        if not isinstance(name, str) or name in signals:
            raise CacheError(f"signals must have a name each, got {name!r:.100}")
        values: Any = arrays.pop(name, None) if texts is None else texts
        if values is None:
            raise CacheError(f"signal {name!r:.100} has no array")
        where = f"signal {name!r:.200}"
        if entry.get("dtype") is not None:
            values = _bfloat16(where, entry["dtype"], values)
        signals[name] = checked_signal(where, name, values, entry.get("kind"), entry.get("frame"))
    if arrays:
        raise CacheError(f"nothing says what the signals {sorted(arrays)} are")
    return signals


def _camera_arrays(cloud: PointCloud) -> dict[str, np.ndarray]:
    cameras = [camera for entry in cloud.meta for camera in entry.get("cameras", [])]
    if not cameras:
        return {}
    intrinsics = {"intrinsics": np.array([camera["intrinsics"][0] for camera in cameras], dtype=np.float64)}
    poses = [camera["world_from_camera"] for camera in cameras]
    return intrinsics if None in poses else {**intrinsics, "extrinsics": np.array(poses, dtype=np.float64)}


def _labels_as_int32(labels: np.ndarray) -> np.ndarray:
    limits = np.iinfo(np.int32)
    if labels.size and (labels.min() < limits.min or labels.max() > limits.max):
        raise CacheError(f"labels are stored as int32, but they reach {labels.min()}..{labels.max()}; renumber them")
    return labels.astype(np.int32)[:, None]


def _array(name: str, value: Tensor) -> np.ndarray:
    try:
        array: np.ndarray = value.detach().numpy()
    except (TypeError, RuntimeError) as error:
        raise CacheError(f"{name}: {value.dtype} cannot be stored: {error}; convert it, e.g. to float32") from error
    return array


def _tensor(name: str, array: np.ndarray) -> Tensor:
    if array.dtype.kind not in "biuf" or not array.dtype.isnative or array.dtype.itemsize > 8:
        raise CacheError(f"array {name!r} has dtype {array.dtype}, which no cloud field has")
    return torch.from_numpy(np.ascontiguousarray(array))
