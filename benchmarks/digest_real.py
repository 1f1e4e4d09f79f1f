"""Real captures from PCDATA_TEST_DATA: in their layouts, and as small frames and clouds to run steps on."""

from __future__ import annotations

import functools
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from digest_inputs import scratch
from digest_names import DepthFrame, open_source, read_pcd, run, step


def real_folder() -> Path | None:
    """The folder of real captures, where the variable names one."""
    name = os.environ.get("PCDATA_TEST_DATA")
    return Path(name) if name else None


@functools.cache
def source_of(name: str) -> Any:
    """A real capture in one of the layouts; copies what lies in another layout into a plain folder."""
    root = real_folder()
    assert root is not None
    if name in COPIED:
        return _copied(root, name)
    return open_source(root / name)


# Depth and color images by a pattern of the number, numbers, and what intrinsics.json says.
COPIED: dict[str, dict[str, Any]] = {
    "tabletop_stream": {
        "depth": "depth_{:03d}.npy",
        "color": "color_{:03d}.png",
        "numbers": range(3),
        "camera": {"width": 1280, "height": 720, "fx": 927.17, "fy": 927.37, "cx": 651.32, "cy": 349.62},
        "metres_per_unit": 0.001,
    },
    "open3d_rgbd": {
        "depth": "depth/{:05d}.png",
        "color": "color/{:05d}.jpg",
        "numbers": range(2),
        "camera": {"width": 640, "height": 480, "fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5},
        "metres_per_unit": 0.001,
    },
    "apc_multiview_shelf": {
        "depth": "frame-{:06d}.depth.png",
        "color": None,
        "numbers": (0, 2),
        "camera": {"width": 640, "height": 480, "fx": 570.0, "fy": 570.0, "cx": 320.0, "cy": 240.0},
        "metres_per_unit": 0.0001,
        "depth_encoding": "rotated",
    },
    "gqcnn_phoxi": {
        "depth": "depth_{:d}.npy",
        "color": None,  # of twice the size
        "numbers": (0,),
        "camera": {"width": 516, "height": 386, "fx": 552.5, "fy": 552.5, "cx": 255.5, "cy": 193.1},
        "metres_per_unit": 1.0,
    },
}


def _copied(root: Path, name: str) -> Any:
    plan, folder = COPIED[name], scratch(f"layouts/{name}")
    for role in ("depth", "color"):
        for number in plan["numbers"] if plan[role] else ():
            file = root / name / plan[role].format(number)
            (folder / role).mkdir(exist_ok=True)
            copy = folder / role / f"f{number}{file.suffix}"
            if file.suffix == ".npy":  # one capture has a third axis of length 1
                np.save(copy, np.load(file, allow_pickle=False).squeeze())
            else:
                shutil.copy(file, copy)
    facts = {key: plan[key] for key in ("metres_per_unit", "depth_encoding") if key in plan}
    (folder / "intrinsics.json").write_text(json.dumps(plan["camera"] | facts))
    return open_source(folder)


def real_frame(name: str, number: int = 0) -> Any:
    source = source_of(name)
    return source.load(source.ids[number])


def joined(frames: Sequence[Any]) -> Any:
    """Captures of one camera as views of one capture, in the frame "base"; one without a pose looks down."""
    first = frames[0]
    k = torch.cat([frame.camera.intrinsics for frame in frames])
    given = [frame.world_from_camera for frame in frames]
    return DepthFrame(
        depth=torch.cat([frame.depth for frame in frames]),
        colors=torch.cat([frame.colors for frame in frames]),
        camera=replace(first.camera, intrinsics=k),
        world_from_camera=torch.tensor(LOOKING_DOWN).double()[None] if given[0] is None else torch.cat(given),
        frame_id="base",
        sample_id="joined",
    )


@functools.cache
def real_frames() -> dict[str, Any]:
    """One view, and two, of real captures; smaller by 4, and by 2."""
    if real_folder() is None:
        return {}
    office = joined([real_frame("seven_scenes", number) for number in (0, 1)])
    table = joined([real_frame("graspnet_frame")])
    return {
        "graspnet": run(step("DecimateDepth", factor=4), table),
        "seven_scenes two": run(step("DecimateDepth", factor=2), office),
    }


@functools.cache
def real_clouds() -> dict[str, Any]:
    """One organized cloud, one whose rows are in no image, and a batch of two; in the frame "base"."""
    root = real_folder()
    if root is None:
        return {}
    frames, deproject = real_frames(), step("Deproject")
    smaller = run(step("DecimateDepth", factor=3), frames["seven_scenes two"])
    table = read_pcd(root / "osd" / "learn33.pcd")
    rows = torch.arange(0, table.num_points, 13)
    return {
        "graspnet": _in_base(run(deproject, run(step("DecimateDepth", factor=2), frames["graspnet"]))),
        "osd": _in_base(table.select(rows, torch.tensor([0, len(rows)]))),
        "seven_scenes two": _in_base(run(deproject, smaller)),
    }


def _in_base(cloud: Any) -> Any:
    """Bring a cloud into "base", where its table lies about z = 0: by its poses, or 0.8 m above it."""
    if "base" in cloud.frames:
        return run(step("ToFrame", frame="base"), cloud)
    return run(step("ToFrame", frame="base", start=cloud.frame_id, matrix=LOOKING_DOWN), cloud)


LOOKING_DOWN = ((1.0, 0.0, 0.0, 0.0), (0.0, -1.0, 0.0, 0.0), (0.0, 0.0, -1.0, 0.8), (0.0, 0.0, 0.0, 1.0))
