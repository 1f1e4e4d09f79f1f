"""What pcdata says of a recording that it wrote: JSON in one message of the topic ``/pcdata``.

``{"schema": 1, "frame_id": "base", "cameras": {"front": {"name": "front", "metres_per_unit": 0.001}},``
``"signals": {"joints": {"name": "joints", "kind": "invariant", "dtype": "float64"}}, "samples": ["a_1", "a_2"],``
``"episodes": [{"id": "pick_0", "first": 0, "length": 24, "attributes": {"task": "pick"}}]}``

Cameras and signals are by the name in their topics, ``/front/depth/...`` and ``/signals/joints``; all but the schema
may be left out. ``first`` counts the depth images from 0. Of several such messages the last one counts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pcdata.errors import CaptureError
from pcdata.files.strict_json import json_object

TOPIC = "/pcdata"
SIGNALS = "/signals/"
SCHEMA = 1
_KNOWN = {"schema", "frame_id", "cameras", "signals", "samples", "episodes"}


@dataclass(frozen=True)
class Statement:
    """What a recording says of itself."""

    frame_id: str | None = None
    cameras: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    signals: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    samples: list[str] | None = None
    episodes: list[dict[str, Any]] | None = None


def read_statement(where: str, text: str) -> Statement:
    """Read the JSON of the topic.

    Raises:
        CaptureError: it is not as above, or of a newer schema.
    """
    where = f"{where}: topic {TOPIC}"
    said = json_object(where, text, error=CaptureError)
    if said.get("schema") != SCHEMA:
        raise CaptureError(f"{where}: is of the schema {said.get('schema')!r:.50}; this pcdata reads {SCHEMA}")
    if unknown := sorted(said.keys() - _KNOWN):
        raise CaptureError(f"{where}: says {unknown[0]!r:.50}, which is not known; it has {', '.join(sorted(_KNOWN))}")
    for name in ("cameras", "signals"):
        part = said.get(name, {})
        if not isinstance(part, dict) or not all(isinstance(one, dict) for one in part.values()):
            raise CaptureError(f"{where}: {name} must be an object of objects")
    samples, episodes, frame = said.get("samples"), said.get("episodes"), said.get("frame_id")
    if samples is not None and not (isinstance(samples, list) and all(isinstance(one, str) for one in samples)):
        raise CaptureError(f"{where}: samples must be a list of names")
    if episodes is not None and not (isinstance(episodes, list) and all(isinstance(one, dict) for one in episodes)):
        raise CaptureError(f"{where}: episodes must be a list of objects")
    if frame is not None and not isinstance(frame, str):
        raise CaptureError(f"{where}: frame_id must be a name")
    return Statement(frame, said.get("cameras", {}), said.get("signals", {}), samples, episodes)
