"""How a command's threads wait, which has to be said before torch is loaded."""

from __future__ import annotations

import os
import sys

# Of GNU's and of Intel's OpenMP: threads that wait for work go to sleep at once instead of spinning. On a machine with
# other work, spinning threads keep each other from the cores and a command takes twenty times as long.
_WAIT_ASLEEP = {"OMP_WAIT_POLICY": "passive", "KMP_BLOCKTIME": "0"}


def wait_asleep() -> None:
    """Let torch's threads wait asleep, unless the environment says how they wait or torch is loaded already."""
    if "torch" in sys.modules or any(name in os.environ for name in (*_WAIT_ASLEEP, "GOMP_SPINCOUNT")):
        return
    os.environ.update(_WAIT_ASLEEP)
