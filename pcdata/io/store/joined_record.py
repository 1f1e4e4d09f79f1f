"""Records of several samples put together, as the record of the batch of their clouds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.io.store.cloud_record import EXTRA, Record
from pcdata.structures.kinds import FIELDS


def joined_record(
    arrays: dict[str, NDArray[Any]],  # name -> the rows of all records, one record after another
    rows: Mapping[str, NDArray[np.int64]],  # name -> (R,) how many are of each record
    infos: Sequence[Any],  # (R,) the facts of each; they are taken apart
) -> Record | None:
    """Return the record of all clouds in a row; None where they cannot share a batch, or one is no cloud.

    Read one by one, they say why.
    """
    info = _joined_info(infos)
    ptr = arrays.get("ptr")
    if info is None or ptr is None or "points" not in arrays or ptr.dtype != np.int64 or ptr.ndim != 1:
        return None
    points, clouds = rows["points"], rows["ptr"] - 1
    if not _belong_together(rows, points, clouds) or clouds.tolist() != [len(own["meta"]) for own in infos]:
        return None
    joined_ptr = _joined_ptr(ptr, points, clouds)
    if joined_ptr is None:
        return None
    return Record({**arrays, "ptr": joined_ptr}, info)


def _belong_together(
    rows: Mapping[str, NDArray[np.int64]], points: NDArray[np.int64], clouds: NDArray[np.int64]
) -> bool:
    """Whether every record's arrays have a row for each of its own points, or clouds."""
    for name, counts in rows.items():
        if name == "ptr":
            continue
        wanted = points if name in FIELDS or name.startswith(EXTRA) else clouds
        if not np.array_equal(counts, wanted):
            return False
    return True


def _joined_ptr(
    ptr: NDArray[np.int64], points: NDArray[np.int64], clouds: NDArray[np.int64]
) -> NDArray[np.int64] | None:
    """Return the row pointers of all clouds, or None where those of a record do not cut its own points."""
    if bool((clouds < 1).any()):
        return None
    last = np.cumsum(clouds + 1) - 1
    first = last - clouds
    if bool(ptr[first].any()) or not np.array_equal(ptr[last], points):
        return None
    moved = ptr + np.repeat(np.cumsum(points) - points, clouds + 1)
    return np.concatenate([np.zeros(1, np.int64), np.delete(moved, first)])


def _joined_info(infos: Sequence[Any]) -> dict[str, Any] | None:
    """Return the facts of all clouds, or None where they differ in what a batch has once."""
    meta: list[Any] = []
    history: list[Any] = []
    for info in infos:
        if not isinstance(info, dict) or not all(isinstance(info.get(name), list) for name in ("meta", "history")):
            return None
        if len(info["meta"]) != len(info["history"]):
            return None
        meta += info["meta"]
        history += info["history"]
    first = infos[0]
    signals = first.get("signals", [])
    if not isinstance(signals, list) or not all(isinstance(entry, dict) for entry in signals):
        return None
    texts = [[*entry["texts"]] if isinstance(entry.get("texts"), list) else None for entry in signals]
    common = _without(first, "meta", "history", "signals")
    told = [_without(entry, "texts") for entry in signals]
    for info in infos[1:]:
        others = info.get("signals", [])
        if _without(info, "meta", "history", "signals") != common or len(others) != len(signals):
            return None
        for own, entry, known in zip(texts, others, told):
            if not isinstance(entry, dict) or _without(entry, "texts") != known:
                return None
            more: Any = entry.get("texts")
            if isinstance(more, list) != (own is not None):
                return None
            if own is not None:
                own += more
    joined = {**common, "meta": meta, "history": history}
    if "signals" in first:
        joined["signals"] = [
            entry if own is None else {**entry, "texts": own} for entry, own in zip(told, texts, strict=True)
        ]
    return joined


def _without(entry: Mapping[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in entry.items() if name not in names}
