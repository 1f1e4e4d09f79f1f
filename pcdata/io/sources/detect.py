"""Which capture layout a path has, by exact signs: nothing is guessed."""

from __future__ import annotations

from pathlib import Path

from pcdata.errors import CaptureError
from pcdata.io.sources.listing import is_folder
from pcdata.io.sources.registry import LAYOUTS
from pcdata.io.sources.source import Source
from pcdata.io.sources.unknown_layout import unknown_layout

# Signs that other layouts may have too, where they have more: a recording that lies beside a capture is not the
# capture, and any folder may have an image with the word depth in its name. Of one rank none is more exact.
_LESS_EXACT = (("realsense_bag", "azure_kinect", "ros", "robomimic", "maniskill"), ("pairs",), ("lerobot",))


def detect_layout(path: Path) -> type[Source]:
    """Return the one layout whose signs are there.

    Raises:
        CaptureError: none is, or more than one.
    """
    fitting = [layout for layout in LAYOUTS.values() if layout.recognizes(path)]
    for less_exact in _LESS_EXACT:
        if len(fitting) > 1 and is_folder(path):
            fitting = [layout for layout in fitting if layout.kind not in less_exact] or fitting
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        kinds = " and ".join(layout.kind for layout in fitting)
        ways = " or ".join(f"--kind {layout.kind}" for layout in fitting)
        raise CaptureError(f"open_source: {path}: looks like {kinds}; say which with kind= ({ways})")
    raise unknown_layout(path)
