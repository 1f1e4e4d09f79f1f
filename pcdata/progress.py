"""How long work tells how far it is: one call after every sample."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """What builds, exports and the command line report to; any function of these three arguments is one."""

    def __call__(self, done: int, total: int, sample_id: str) -> None:
        """Hear that ``done`` of ``total`` samples are finished, ``sample_id`` the last of them."""
