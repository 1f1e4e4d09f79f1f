"""Read what a simulator stored: robosuite's observations as they are, and a capture with OpenGL's cameras.

With the path of a file of robomimic or ManiSkill it tells what lies there.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import h5py
import numpy as np

import pcdata

NEAR, FAR = 0.02, 20.0  # metres: znear and zfar of the model times its extent
HEIGHT, WIDTH, FOCAL = 48, 64, 60.0


def made_demonstration(folder: Path) -> Path:
    """Write one step as robosuite observes it: a buffer between two planes, the bottom row first."""
    floor = np.linspace(2.0, 0.6, HEIGHT)[:, None] * np.ones((1, WIDTH))  # metres, near at the bottom of the image
    buffer = (1 - NEAR / floor) / (1 - NEAR / FAR)
    path = folder / "demo.hdf5"
    with h5py.File(path, "w") as file:
        obs = file.create_group("data/demo_0/obs")
        obs["agentview_depth"] = buffer[::-1].astype(np.float32)[None, ..., None]
        obs["robot0_joint_pos"] = np.zeros((1, 7))
        file["data/demo_0/actions"] = np.zeros((1, 7))
    return path


def made_capture(folder: Path) -> Path:
    """Write a capture of a camera that looks along -z, as OpenGL, Blender, MuJoCo and Isaac Sim have it."""
    for name in ("depth", "poses"):
        (folder / name).mkdir(parents=True)
    np.save(folder / "depth" / "0.npy", np.full((HEIGHT, WIDTH), 1.5, np.float32))
    looks_down = "1 0 0 0\n0 1 0 0\n0 0 1 2\n0 0 0 1\n"  # 2 m above the floor: its -z is the world's
    (folder / "poses" / "0.txt").write_text(looks_down)
    k = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    (folder / "intrinsics.json").write_text(json.dumps(k | {"metres_per_unit": 1.0}))
    return folder


def tell(source: pcdata.CaptureSource) -> None:
    """Say what the first capture holds."""
    frame = source.load(source.ids[0])
    cloud = pcdata.Deproject()(frame)
    if frame.frame_id is not None:
        cloud = pcdata.ToFrame(frame=frame.frame_id)(cloud)
    low, high = cloud.points.amin(0).tolist(), cloud.points.amax(0).tolist()
    print(f"{source.name}: {len(source)} captures, signals {', '.join(frame.recorded_signals) or 'none'}")
    print(f"  points in {cloud.frame_id!r} from {[round(x, 2) for x in low]} to {[round(x, 2) for x in high]} m")


if len(sys.argv) > 1:
    tell(pcdata.open_source(sys.argv[1]))
    sys.exit()

with tempfile.TemporaryDirectory() as made:
    # 1. What the file does not say is asked for: metres or a buffer, which row is first, the planes, the intrinsics.
    said = {"depth_values": "z_buffer", "rows": "bottom_first", "near": NEAR, "far": FAR}
    camera = {"camera": "agentview", "intrinsics": (FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)}
    demonstration = pcdata.open_source(made_demonstration(Path(made)), **said, **camera)
    tell(demonstration)
    print(f"  episodes: {[(one.id, one.length) for one in demonstration.episodes]}")

    # 2. A convention is said around any layout; width / 2 counts from the corner of the first pixel.
    capture = made_capture(Path(made) / "capture")
    tell(pcdata.open_source(capture, convention={"axes": "opengl", "principal_point": "corner"}))
