"""Does ``pcdata drift`` see that a camera moved, and only then? Synthetic sessions with known steps and slow ramps.

    python benchmarks/drift.py [--still 50]     # about 4 minutes; writes results/drift.json

Every session is a table with objects, seen by one camera with the noise of a stereo sensor; in half of them an arm
sweeps through a tenth of the image. A step comes after half of the session, a ramp over all of it.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import platform
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from pcdata.geometry.small_motions import motion_from_twist
from pcdata.structures import DepthFrame
from pcdata.synthetic import tabletop
from pcdata.validation.drift import measure_drift

RESULT = Path(__file__).parent / "results" / "drift.json"
STEPS = ((2, 0), (5, 0), (10, 0), (0, 0.2), (0, 0.5), (0, 1.0), (2, 0.2))  # mm, degrees
RAMPS = ((5, 0), (0, 0.5))
SIZE = HEIGHT, WIDTH = 240, 320
LENGTH = 40


class Session:
    """A recording of one camera that is where ``motions`` say."""

    name = "synthetic"

    def __init__(self, seed: int, motions: list[torch.Tensor], *, busy: bool) -> None:
        pose = tabletop(seed, size=SIZE).frame.world_from_camera
        assert pose is not None
        self.frames: list[DepthFrame] = []
        for motion, group in itertools.groupby(motions, key=lambda one: tuple(one.flatten().tolist())):
            moved = pose @ torch.tensor(motion, dtype=torch.float64).reshape(4, 4)
            scene = tabletop(seed, noise="stereo", size=SIZE, world_from_camera=moved)
            self.frames += [scene.render(seed_noise=len(self.frames) + place) for place, _ in enumerate(group)]
        self.frames = [self._alone(frame, place, busy) for place, frame in enumerate(self.frames)]
        self.ids = [str(frame.sample_id) for frame in self.frames]

    def _alone(self, frame: DepthFrame, place: int, busy: bool) -> DepthFrame:
        """Without a pose, as a recording of a camera on a stand is, with an arm in the way."""
        depth = frame.depth.clone()
        if busy:
            x = int((0.5 + 0.45 * math.sin(0.9 * place)) * (WIDTH - 90))
            y = int((0.5 + 0.4 * math.cos(0.5 * place)) * (HEIGHT - 110))
            part = depth[0, y : y + 100, x : x + 80]
            nearer = (part - 0.12 - 0.05 * math.sin(place)).clamp(min=0.2)
            depth[0, y : y + 100, x : x + 80] = torch.where(part > 0, nearer, part)
        return replace(frame, depth=depth, world_from_camera=None, frame_id=None, colors=None, sample_id=f"c{place:03}")

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id: str) -> DepthFrame:
        return self.frames[self.ids.index(sample_id)]


def motion(seed: int, millimetres: float, degrees: float) -> torch.Tensor:
    """(4, 4): so far, in a direction drawn by the seed."""
    directions = torch.randn(2, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    directions = torch.nn.functional.normalize(directions, dim=1)
    twist = torch.cat([math.radians(degrees) * directions[0], millimetres / 1e3 * directions[1]])
    return motion_from_twist(twist, torch.zeros(3, dtype=torch.float64))


def measured(session: Session) -> dict[str, Any]:
    """What drift says of a session; the camera's own shift is where it ends."""
    (camera,) = measure_drift(session, num_windows=8).cameras
    tail = torch.tensor([point.camera_shift for point in camera.points[-3:]])
    return {
        "verdict": str(camera.verdict),
        "kind": camera.kind,
        "since": camera.since,
        "camera_mm": round(1e3 * float(tail.median(0).values.norm()), 3),
        "last_mm": round(1e3 * float(tail[-1].norm()), 3),
        "degrees": round(camera.rotation_degrees, 4),
        "last_degrees": round(camera.points[-1].rotation_degrees, 4),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--still", type=int, default=50, help="sessions in which nothing moves")
    parser.add_argument("--seeds", type=int, default=3, help="sessions for every step and ramp")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    here = torch.eye(4, dtype=torch.float64)
    begun = time.perf_counter()
    rows: list[dict[str, Any]] = []
    for (millimetres, degrees), seed in itertools.product(STEPS, range(arguments.seeds)):
        moved = motion(seed, millimetres, degrees)
        session = Session(seed, [here] * (LENGTH // 2) + [moved] * (LENGTH // 2), busy=seed % 2 == 1)
        rows.append({"what": "step", "mm": millimetres, "degrees_true": degrees, "seed": seed, **measured(session)})
        print(rows[-1], flush=True)
    for (millimetres, degrees), seed in itertools.product(RAMPS, range(arguments.seeds)):
        motions = [
            motion(seed, millimetres * place / (LENGTH - 1), degrees * place / (LENGTH - 1)) for place in range(LENGTH)
        ]
        session = Session(seed, motions, busy=seed % 2 == 1)
        rows.append({"what": "ramp", "mm": millimetres, "degrees_true": degrees, "seed": seed, **measured(session)})
        print(rows[-1], flush=True)
    alarms = []
    largest = 0.0
    for seed in range(arguments.still):
        told = measured(Session(100 + seed, [here] * LENGTH, busy=seed % 2 == 1))
        largest = max(largest, told["camera_mm"])
        if told["verdict"] not in ("pass", "unknown"):
            alarms.append({"seed": seed, **told})
    found = [row for row in rows if row["verdict"] == "fail"]
    result = {
        "benchmark": "drift",
        "machine": platform.machine(),
        "sessions": rows,
        "found": len(found),
        "of": len(rows),
        "still": {"sessions": arguments.still, "alarms": alarms, "largest_mm": largest},
        "seconds": round(time.perf_counter() - begun, 1),
    }
    RESULT.write_text(json.dumps(result, indent=1) + "\n")
    print(
        f"{len(found)} of {len(rows)} found; {len(alarms)} false alarms in {arguments.still}, largest {largest:.2f} mm"
    )


if __name__ == "__main__":
    main()
