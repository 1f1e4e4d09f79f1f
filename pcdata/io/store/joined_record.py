"""Records of several samples put together, as the record of the batch of their clouds; and facts taken apart for it."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import CacheError
from pcdata.io.store.cloud_record import EXTRA, SIGNALS, Record, parse_info
from pcdata.structures.kinds import FIELDS
from pcdata.structures.read_later import StoredMeta, StoredSteps, StoredTexts

_OWN = ("meta", "history")  # facts that differ from sample to sample, as do the texts of signals


def split_info(record: Record) -> tuple[dict[str, Any], str, str]:
    """Return what a record's facts have in common with other samples', its own, and its history, the last two as JSON.

    Together they are all of them.
    """
    common, own = common_and_own(record.info)
    text = record.info_text()
    if Record({}, merged_info(common, own)).info_text() != text:  # not what is usual; told when it is read
        return {}, text, ""
    history = (
        json.dumps(own.pop("history"), sort_keys=True, separators=(",", ":"), allow_nan=False)
        if "history" in own
        else ""
    )
    return common, json.dumps(own, sort_keys=True, separators=(",", ":"), allow_nan=False), history


def common_and_own(info: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the facts that a sample has in common with others, and its own."""
    own: dict[str, Any] = {name: info[name] for name in _OWN if name in info}
    common = {name: value for name, value in info.items() if name not in _OWN}
    signals = common.get("signals", [])
    own["texts"] = [entry.get("texts") for entry in signals]
    if signals:
        common["signals"] = [{name: one for name, one in entry.items() if name != "texts"} for entry in signals]
    return common, own


def own_info(text: bytes, history: bytes) -> dict[str, Any]:
    """Return the facts of a record's own.

    Raises:
        CacheError: they are not JSON, or a cloud has no history.
    """
    own = parse_info(text)
    if history:
        own |= parse_info(b'{"history":' + history + b"}")
        meta, steps = own.get("meta", ()), own["history"]
        if not (_is_list(meta) and _is_list(steps) and len(meta) == len(steps) and all(map(_is_list, steps))):
            raise CacheError(f"history must be a list with one list per cloud, got {steps!r:.100}")
        if not all(type(one) is dict for one in meta):
            raise CacheError(f"meta must be a list with one object per cloud, got {meta!r:.100}")
    return own


def merged_info(common: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return the facts that were split.

    Raises:
        CacheError: these never were.
    """
    info = {**common, **own}
    texts = info.pop("texts", [])
    signals = common.get("signals", [])
    if not isinstance(texts, list) or not isinstance(signals, list) or len(texts) != len(signals):
        raise CacheError(f"has {texts!r:.100} as the texts of the signals {signals!r:.100}")
    if signals:
        info["signals"] = [
            entry if one is None else {**entry, "texts": one} for entry, one in zip(signals, texts, strict=True)
        ]
    return info


def joined_record(
    arrays: dict[str, NDArray[Any]],  # name -> the rows of all records, one record after another
    rows: Mapping[str, NDArray[np.int64]],  # name -> (R,) how many are of each record
    common: Mapping[str, Any],  # the facts that all have
    owns: StoredTexts | Sequence[Any],  # (R,) the other facts of each, but for the history; as JSON, or read
    histories: StoredTexts,  # (R,) as JSON
) -> Record | None:
    """Return the record of all clouds in a row; None where they cannot share a batch, or one is no cloud.

    Read one by one, they say why. Of records of one cloud each, what differs from sample to sample is not parsed before
    somebody asks for it.
    """
    ptr = arrays.get("ptr")
    if ptr is None or "points" not in arrays or ptr.dtype != np.int64 or ptr.ndim != 1:
        return None
    points, clouds = rows["points"], rows["ptr"] - 1
    if not _belong_together(rows, points, clouds):
        return None
    joined_ptr = _joined_ptr(ptr, points, clouds)
    if joined_ptr is None:
        return None
    arrays = {**arrays, "ptr": joined_ptr}
    read: Sequence[Any]
    if isinstance(owns, StoredTexts):
        if bool((clouds == 1).all()) and signals_are_arrays(arrays, common):
            if not all(_lengths(one).min() for one in (owns, histories)):
                return None
            return Record(arrays, {**common, "meta": StoredMeta(owns), "history": StoredSteps(histories)})
        # The strict parser looked at each when its digest was compared.
        read = json.loads(b"[" + b",".join(owns) + b"]")
    else:
        read = owns
    own = _joined_own(read, histories)
    if own is None or clouds.tolist() != [len(one["meta"]) for one in read]:
        return None
    return Record(arrays, merged_info(common, own))


def signals_are_arrays(names: Iterable[str], common: Mapping[str, Any]) -> bool:
    """Whether all signals of a record with such arrays are among them, and none is a text."""
    return sum(name.startswith(SIGNALS) for name in names) == len(common.get("signals", ()))


def is_per_point(name: str) -> bool:
    """Whether an array of a record has a row for each point; the others, but for ``ptr``, have one for each cloud."""
    return name in FIELDS or name.startswith(EXTRA)


def _lengths(texts: StoredTexts) -> NDArray[np.int64]:
    return np.diff(texts.ends, prepend=np.int64(0))


def _belong_together(
    rows: Mapping[str, NDArray[np.int64]], points: NDArray[np.int64], clouds: NDArray[np.int64]
) -> bool:
    """Whether every record's arrays have a row for each of its own points, or clouds."""
    for name, counts in rows.items():
        if name == "ptr":
            continue
        wanted = points if is_per_point(name) else clouds
        if not np.array_equal(counts, wanted):
            return False
    return True


def _joined_ptr(
    ptr: NDArray[np.int64], points: NDArray[np.int64], clouds: NDArray[np.int64]
) -> NDArray[np.int64] | None:
    """Return the row pointers of all clouds, or None where those of a record do not cut its own points."""
    if bool((clouds < 1).any()):
        return None
    if bool((clouds == 1).all()):
        if bool(ptr[::2].any()) or not np.array_equal(ptr[1::2], points):
            return None
        return np.concatenate([np.zeros(1, np.int64), np.cumsum(points)])
    last = np.cumsum(clouds + 1) - 1
    first = last - clouds
    if bool(ptr[first].any()) or not np.array_equal(ptr[last], points):
        return None
    moved = ptr + np.repeat(np.cumsum(points) - points, clouds + 1)
    return np.concatenate([np.zeros(1, np.int64), np.delete(moved, first)])


def _joined_own(owns: Sequence[Any], histories: StoredTexts) -> dict[str, Any] | None:
    """Return the facts of all samples' own in a row."""
    joined: dict[str, Any] = {"meta": []}
    texts: list[Any] = []
    for own in owns:
        if type(own) is not dict or len(own) != 2:
            return None
        if type(own.get("meta")) is not list or type(own.get("texts")) is not list:
            return None
        joined["meta"] += own["meta"]
        texts.append(own["texts"])
    if len(joined["meta"]) == len(owns):
        joined["history"] = StoredSteps(histories)
    else:
        joined["history"] = [*itertools.chain.from_iterable(map(json.loads, histories))]
    if any(any(each) for each in texts):
        told = [[*of_signal] for of_signal in zip(*texts, strict=True)]
        if not all(all(map(_is_list, each)) or not any(each) for each in told):
            return None
        joined["texts"] = [[*itertools.chain.from_iterable(each)] if _is_list(each[0]) else None for each in told]
    else:
        joined["texts"] = [None] * len(texts[0])
    return joined


def _json(value: Any) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _is_list(value: Any) -> bool:
    return type(value) is list
