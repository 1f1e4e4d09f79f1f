"""How much more memory a process holds at its highest point than when it began to be watched. Linux alone."""

from __future__ import annotations

from pathlib import Path


class Growth:
    """The peak of the resident memory over what it was when this was made."""

    def __init__(self) -> None:
        Path("/proc/self/clear_refs").write_text("5")  # makes the peak what it is now
        self._before = _resident("VmRSS")

    def peak(self) -> int:
        """Bytes."""
        return _resident("VmHWM") - self._before


def _resident(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return 1024 * int(line.split()[1])
    raise OSError(f"/proc/self/status has no {name}")
