"""What the views of a capture are called in findings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def view_names(provenance: Mapping[str, Any], count: int) -> list[str]:
    """Return ``view 0``, ``view 1``, ..., each with its camera where ``provenance["cameras"]`` names one per view."""
    cameras = provenance.get("cameras", ())
    if len(cameras) != count:
        return [f"view {view}" for view in range(count)]
    return [f"view {view} ({camera})" for view, camera in enumerate(cameras)]
