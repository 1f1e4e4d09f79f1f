"""What a source of captures holds, as plain facts: read from its lists, and from its first and last capture."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import torch
from torch import Tensor

from pcdata.errors import PcdataError
from pcdata.io.sources.capture_source import (
    CaptureSource,
    episodes_of,
    kinds_of,
    reason_of,
    skipped_of,
    unread_of,
)
from pcdata.io.sources.layouts import LAYOUTS
from pcdata.io.sources.registry import options_of
from pcdata.io.sources.source import Source, stored_captures
from pcdata.structures import DepthFrame, PointCloud, Signal

SCHEMA = "pcdata.inspection/1"
_GAP = 1.5  # of the median step in time: a longer one is a gap
_MOST_FILES = 20_000  # whose sizes are asked for
_IMAGES = {"colors": "color", "labels": "labels", "confidence": "confidence", "mask": "mask"}
_SENSOR = ("sensor", "sensor_name", "serial", "registered_to")


def capture_facts(source: CaptureSource) -> dict[str, Any]:
    """Return what a source holds, as JSON can hold it; loads its first and its last capture.

    Raises:
        PcdataError: the first capture cannot be read.
    """
    first = source.load(source.ids[0])
    facts: dict[str, Any] = {
        "schema": SCHEMA,
        "name": str(source.name),
        "layout": kinds_of(source) or [type(source).__name__],
        "captures": len(source),
        "ids": source.ids[:3],
        "bytes": _bytes(source),
        "first": repr(first),
    }
    facts |= _frame_facts(first) if isinstance(first, DepthFrame) else _cloud_facts(first)
    if isinstance(first, DepthFrame):
        facts["changes"] = _changes(first, source)
    facts["signals"] = {name: _signal_facts(signal) for name, signal in first.recorded_signals.items()}
    facts["episodes"] = [
        {"id": one.id, "captures": one.length, "attributes": dict(one.attributes), **time_facts(one.times)}
        for one in episodes_of(source)
    ]
    facts["time"] = _time_facts(source)
    facts["streams"] = list(getattr(source, "streams", ()))
    facts["left_out"] = skipped_of(source)
    facts["missing"] = _missing(first, facts)
    facts["not_read"] = unread_of(source)
    return facts


def time_facts(times: Sequence[float]) -> dict[str, Any]:
    """Return how long, how often, and how even: of steps in seconds, in order."""
    if len(times) < 2:
        return {}
    steps = [later - earlier for earlier, later in itertools.pairwise(times)]
    usual = median(steps)
    gaps = sum(step > _GAP * usual for step in steps) if usual > 0 else 0
    rate = {"rate_hz": 1 / usual} if usual > 0 else {}
    return {"seconds": times[-1] - times[0], **rate, "gaps": gaps, "largest_gap_s": max(steps)}


def _frame_facts(frame: DepthFrame) -> dict[str, Any]:
    camera, said = frame.camera, frame.provenance
    names = said.get("cameras") or [f"view{view}" for view in range(frame.num_views)]
    valid = frame.depth[frame.depth > 0]
    depth: dict[str, Any] = {"valid": int(valid.numel()), "pixels": int(frame.depth.numel())}
    if valid.numel():
        depth |= {"nearest_m": float(valid.min()), "median_m": float(valid.median()), "farthest_m": float(valid.max())}
    return {
        "cameras": [
            {
                "name": str(name),
                "width": frame.size[1],
                "height": frame.size[0],
                **{word: k[row][column] for word, row, column in _PINHOLE},
                "lens": None if camera.distortion is None else camera.distortion.shape[1],
            }
            for name, k in zip(names, camera.intrinsics.tolist())
        ],
        "depth": depth,
        "metres_per_unit": said.get("metres_per_unit"),
        "unit_source": said.get("unit_source"),
        "depth_encoding": said.get("depth_encoding", "plain"),
        "images": [name for attribute, name in _IMAGES.items() if getattr(frame, attribute) is not None],
        "poses": frame.frame_id,
        "sensor": {name: said[name] for name in _SENSOR if said.get(name) is not None},
    }


_PINHOLE = (("fx", 0, 0), ("fy", 1, 1), ("cx", 0, 2), ("cy", 1, 2))


def _cloud_facts(cloud: PointCloud) -> dict[str, Any]:
    extent = [cloud.points.amin(0).tolist(), cloud.points.amax(0).tolist()] if cloud.num_points else None
    return {"extent_m": extent, "fields": list(cloud.fields())}


def _signal_facts(signal: Signal) -> dict[str, Any]:
    if not isinstance(signal.values, Tensor):
        return {"kind": signal.kind, "text": signal.values[0]}
    dtype = str(signal.values.dtype).removeprefix("torch.")
    return {"kind": signal.kind, "frame": signal.frame, "shape": list(signal.values.shape[1:]), "dtype": dtype}


def _changes(first: DepthFrame, source: CaptureSource) -> dict[str, Any]:
    """Return what differs from the first capture to the last: how far cameras went, whether intrinsics did."""
    if len(source) < 2:
        return {}
    try:
        last = source.load(source.ids[-1])
    except PcdataError as error:
        return {"last": reason_of(error)}
    if not isinstance(last, DepthFrame) or last.num_views != first.num_views:
        return {"last": repr(last)}
    found: dict[str, Any] = {}
    if first.camera.to_dict() != last.camera.to_dict():
        found["intrinsics"] = True
    if first.world_from_camera is not None and last.world_from_camera is not None:
        apart = (first.world_from_camera[:, :3, 3] - last.world_from_camera[:, :3, 3]).norm(dim=1)
        found["cameras_moved_m"] = [float(metres) for metres in apart]
        if bool((apart == 0).all()) and not torch.equal(first.world_from_camera, last.world_from_camera):
            found["cameras_turned"] = True
    return found


def _time_facts(source: CaptureSource) -> dict[str, Any]:
    """Return the time facts of all captures where no episode has them."""
    if episodes_of(source) or not isinstance(source, Source):
        return {}
    times = source.times()
    return time_facts([times[sample_id] for sample_id in source.ids if sample_id in times])


def _missing(first: DepthFrame | PointCloud, facts: Mapping[str, Any]) -> list[str]:
    if not isinstance(first, DepthFrame):
        return []
    lines = [str(line) for line in first.provenance.get("missing", ())]
    if first.world_from_camera is None:
        takes_one = all(
            "calibration" in options_of(LAYOUTS[kind]) for kind in facts.get("layout", ()) if kind in LAYOUTS
        )
        given = " (--calibration FILE --frame NAME gives them)" if takes_one else ""
        lines.append(f"poses: clouds stay in the camera's frame{given}")
    if first.colors is None:
        lines.append("color")
    if facts["episodes"] and facts["captures"] > 1 and not any("seconds" in one for one in facts["episodes"]):
        lines.append("times of the captures")
    if facts["episodes"] and not facts["signals"]:
        lines.append("signals: no states, actions or texts")
    return lines


def _bytes(source: CaptureSource) -> int | None:
    """Return the size of all files that captures are read from; None where there are none, or too many to ask."""
    found: set[Path] = set()
    if len(source) > _MOST_FILES:
        return None
    for sample_id in source.ids:
        for stored, own in stored_captures(source, sample_id):
            found.update(stored.files(own).values())
        if len(found) > _MOST_FILES:
            return None
    try:
        return sum(file.stat().st_size for file in found) if found else None
    except OSError:
        return None
