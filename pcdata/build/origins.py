"""Where the samples of a build come from, as their captures say: sensors, depth, frames, fields, with counts.

Few captures differ in it, so a manifest keeps each kind once, with the number of its samples.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

from pcdata.structures import PointCloud

OTHERS = "others"
_SENSOR = ("sensor", "sensor_name", "serial", "registered_to")  # in the provenance of a capture
_MOST = 50  # kinds of samples that are told apart; of more, the commonest
_LONGEST = 300  # characters of one fact

Origin = Mapping[str, Any]


def origin_of(cloud: PointCloud) -> dict[str, Any]:
    """Return what the capture of a sample says of itself, and what its cloud knows."""
    said = [meta.get("provenance") for meta in cloud.meta]
    views = [one if isinstance(one, Mapping) else {} for one in said] or [{}]
    told = {
        "sensor": [", ".join(f"{name} {one[name]}" for name in _SENSOR if one.get(name) is not None) for one in views],
        "depth": [_depth(one) for one in views],
    }
    origin = {name: " and ".join(dict.fromkeys(filter(None, texts)))[:_LONGEST] for name, texts in told.items()}
    fields = {name: str(value.dtype).removeprefix("torch.") for name, value in cloud.fields().items()}
    return {
        **origin,
        "frame": cloud.frame_id,
        "unit": cloud.unit,
        "source_frame": cloud.source_frame,
        "frames": sorted({*cloud.frames} - {cloud.source_frame}),
        "fields": fields,
    }


def _depth(provenance: Mapping[str, Any]) -> str:
    """Say how far the depth that was read may be from what the sensor stored; "" = nobody knows."""
    unit = provenance.get("metres_per_unit")
    if "depth_error_mm" in provenance:
        bound = provenance["depth_error_mm"]
        return f"off by at most {bound} mm, as the codec of the source states" if bound is not None else ""
    if isinstance(unit, (int, float)) and unit > 0:
        return (
            f"read exactly, in the steps of {unit * 1000:g} mm that it was stored in" if unit != 1 else "read exactly"
        )
    return ""


def joined(origins: Iterable[Origin]) -> list[dict[str, Any]]:
    """Join equal origins, with their number as ``samples``, in the order in which they first come."""
    kinds: dict[str, dict[str, Any]] = {}
    for origin in origins:
        own = {name: value for name, value in origin.items() if name != "samples"}
        kind = kinds.setdefault(json.dumps(own, sort_keys=True), {**own, "samples": 0})
        kind["samples"] += origin.get("samples", 1)
    return [*kinds.values()]


def commonest(origins: Iterable[Origin]) -> list[dict[str, Any]]:
    """Join equal origins; of more than 50 kinds the rest is one entry: ``others``, their number, and ``samples``."""
    kinds = joined(origins)
    kept = {id(kind) for kind in sorted(kinds, key=lambda kind: -kind["samples"])[:_MOST]}
    rest = [kind["samples"] for kind in kinds if id(kind) not in kept]
    shown = [kind for kind in kinds if id(kind) in kept]
    return [*shown, {OTHERS: len(rest), "samples": sum(rest)}] if rest else shown
