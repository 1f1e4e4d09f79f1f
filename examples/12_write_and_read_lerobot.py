"""Write demonstrations as a LeRobot dataset, and read them back; any other captures go the same way.

With a path it tells what a LeRobot dataset holds: ``11_write_and_read_lerobot.py DATASET``.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import torch

import pcdata
from pcdata.io import convert
from pcdata.synthetic import TeleopSource


def tell(path: Path) -> None:
    """Say what is read, and what is not."""
    source = pcdata.open_source(path)
    first = source.load(source.ids[0])
    print(f"{len(source)} steps of {len(source.episodes)} episodes; cameras {first.provenance.get('cameras')}")
    for name, signal in first.recorded_signals.items():
        print(f"  {name}: {signal}")
    for line in source.unread():
        print(f"not read: {line}")


def there_and_back(folder: Path) -> None:
    """Round depth to tenths of a millimetre, and compare what comes back."""
    made = TeleopSource(num_episodes=2, num_views=2, size=(48, 64))
    report = convert(made, "lerobot", folder, metres_per_unit=0.0001, state=["joints", "gripper"])
    for what, loss in report.lost.items():
        print(f"lost of {what}: {loss}")
    source = pcdata.open_source(folder)
    before, after = made.load(made.ids[7]), source.load(source.ids[7])
    print(f"depth differs by {1000 * float((before.depth - after.depth).abs().max()):.3f} mm at most")
    assert torch.equal(before.signals["joints"], after.signals["joints"])


if __name__ == "__main__":
    if len(sys.argv) == 2:
        tell(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as parent:
            there_and_back(Path(parent) / "dataset")
            tell(Path(parent) / "dataset")
