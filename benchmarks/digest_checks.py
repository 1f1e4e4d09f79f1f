"""Digests of every validation check over captures and faults."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import torch
from digest_hash import Many
from digest_inputs import Samples, scratch
from digest_names import check_row, open_source, reports, run, step, tabletop, validate_frame, write_color
from digest_real import real_folder, source_of
from PIL import Image

Case = tuple[str, Callable[[], Any]]


@cache
def scene(num_views: int = 2, seed: int = 0) -> Any:
    """A table with a stereo camera's noise, seen well enough to judge poses."""
    return tabletop(seed, 8, num_views, noise="stereo", size=(240, 320)).frame


def moved(frame: Any, view: int = 0, *, shift: float = 0.03) -> Any:
    """The capture with the pose of one view off."""
    poses = frame.world_from_camera.clone()
    poses[view, 0, 3] += shift
    return replace(frame, world_from_camera=poses)


def scaled(frame: Any, factor: float) -> Any:
    """The capture as if its depth were stored in another unit."""
    return replace(frame, depth=frame.depth * factor)


def _turned(frame: Any) -> Any:
    """The capture with its poses the wrong way round."""
    return replace(frame, world_from_camera=torch.linalg.inv(frame.world_from_camera))


def _other_lens(frame: Any) -> Any:
    """The capture with the intrinsics of a larger image."""
    k = frame.camera.intrinsics.clone()
    k[:, :2] *= 1.25
    return replace(frame, camera=replace(frame.camera, intrinsics=k))


def _color_aside(frame: Any) -> Any:
    return replace(frame, colors=frame.colors.roll(6, dims=2))


def _with_hole(frame: Any) -> Any:
    depth = frame.depth.clone()
    depth[:, 60:180, 80:240] = 0
    return replace(frame, depth=depth)


def _saturated(frame: Any) -> Any:
    depth = frame.depth.clone()
    depth[:, :40] = 1.9
    return replace(frame, depth=depth)


FAULTS: dict[str, Callable[[Any], Any]] = {
    "clean": lambda frame: frame,
    "unit x 10": lambda frame: scaled(frame, 10.0),
    "unit x 0.25": lambda frame: scaled(frame, 0.25),
    "unit x 1.25": lambda frame: scaled(frame, 1.25),
    "moved pose": moved,
    "slightly moved pose": lambda frame: moved(frame, shift=0.004),
    "turned poses": _turned,
    "intrinsics of another size": _other_lens,
    "color aside": _color_aside,
    "hole": _with_hole,
    "saturated": _saturated,
    "no pose": lambda frame: replace(frame, world_from_camera=None, frame_id=None),
}


def _checked(source: Any) -> Many:
    """The checks of every capture, a digest for each name."""
    found: dict[str, list[Any]] = {}
    for sample_id, rows in reports(source):
        for name, row in rows:
            found.setdefault(name, []).append((sample_id, *row))
    return Many(found)


def _frame_checked(frame: Any) -> Many:
    found: dict[str, list[Any]] = {}
    for check in validate_frame(frame):
        found.setdefault(check.name, []).append(check_row(check))
    return Many(found)


def _series(change: Callable[[Any], Any] = lambda frame: frame) -> Samples:
    """Four moments of one camera that goes around the table; the fault is in the second."""
    frame = scene(4)
    views = [frame.view(view) for view in range(4)]
    return Samples({f"f{n}": change(view) if n == 1 else view for n, view in enumerate(views)})


def _repeated() -> Samples:
    frame = scene(4)
    return Samples({f"f{n}": frame.view(view) for n, view in enumerate((0, 1, 1, 2))})


def _clouds() -> Samples:
    """Clouds in the frame of a camera, one of them partly behind it."""
    clouds = [run(step("Deproject"), scene(2, seed).view(0)) for seed in (0, 1)]
    behind = clouds[1].points.clone()
    behind[::20, 2] *= -1
    return Samples({"before": clouds[0], "behind": replace(clouds[1], points=behind)})


def _timed() -> Samples:
    """Captures of two views that drift apart in time, with a pause and a clock that goes back."""
    frame = scene()
    times = [(0.0, 0.001), (0.033, 0.06), (0.066, 0.2), (0.5, 0.501), (0.4, 0.4), (0.433, 0.434)]
    changed = [replace(frame, depth=frame.depth + 0.0001 * n) for n in range(len(times))]
    return Samples({f"f{n}": replace(one, provenance={"timestamps": [*times[n]]}) for n, one in enumerate(changed)})


def _folder(*, unit: float = 0.001, encoding: str = "plain", mirrored: bool = False, spoilt: bool = False) -> Any:
    """Two captures stored as files, with what a person may get wrong in them."""
    folder, frame = scratch("checked"), scene()
    for name in ("depth", "color", "poses"):
        (folder / name).mkdir()
    for view in range(2):
        stored = (frame.depth[view] / 0.001).round().to(torch.int32).numpy().astype(np.uint16)
        if encoding == "rotated":
            stored = (stored << 3) | (stored >> 13)
        if spoilt:
            wrong = frame.depth[view].numpy().copy()
            wrong[:5, :7], wrong[9, 9] = np.nan, -1.0
            np.save(folder / "depth" / f"f{view}.npy", wrong)
        else:
            Image.fromarray(stored).save(folder / "depth" / f"f{view}.png")
        write_color(folder / "color" / f"f{view}.png", frame.colors[view])
        pose = frame.world_from_camera[view].clone()
        pose[:3, 0] *= -1 if mirrored else 1
        np.savetxt(folder / "poses" / f"f{view}.txt", pose.numpy())
    (fx, _, cx), (_, fy, cy), _ = frame.camera.intrinsics[0].tolist()
    size = {"width": frame.size[1], "height": frame.size[0]}
    facts = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "metres_per_unit": 1.0 if spoilt else unit, **size}
    (folder / "intrinsics.json").write_text(json.dumps(facts))
    (folder / "timestamps.json").write_text(json.dumps({"f0": 1.0, "f1": 0.5}))
    return open_source(folder)


def _part(name: str, count: int, change: Callable[[Any], Any] = lambda frame: frame) -> Samples:
    source = source_of(name)
    return Samples({sample_id: change(source.load(sample_id)) for sample_id in source.ids[:count]})


def _validations() -> Iterator[Case]:
    for name, change in FAULTS.items():
        yield f"check/frame {name}", lambda change=change: _frame_checked(change(scene()))
    for name in ("clean", "unit x 10", "moved pose", "turned poses", "color aside"):
        yield f"check/series {name}", lambda name=name: _checked(_series(FAULTS[name]))
    yield "check/series repeated", lambda: _checked(_repeated())
    yield "check/clouds", lambda: _checked(_clouds())
    yield "check/times", lambda: _checked(_timed())
    files: dict[str, dict[str, Any]] = {
        "clean": {},
        "unit x 10": {"unit": 0.01},
        "unit x 0.25": {"unit": 0.00025},
        "rotated bits": {"encoding": "rotated"},
        "mirrored poses": {"mirrored": True},
        "NaN and negative": {"spoilt": True},
    }
    for name, options in files.items():
        yield f"check/files {name}", lambda options=options: _checked(_folder(**options))
    yield "check/series all turned", lambda: _checked(Samples({f"f{n}": _turned(scene(4).view(n)) for n in range(4)}))
    if real_folder() is None:
        return
    for name, count in {
        "graspnet_frame": 1,
        "seven_scenes": 3,
        "pcd": 2,
        "open3d_rgbd": 2,
        "tabletop_stream": 2,
    }.items():
        yield (
            f"check/{name}",
            lambda name=name, count=count: _checked(source_of(name).subset(source_of(name).ids[:count])),
        )
    yield "check/osd", lambda: _checked(source_of("osd").subset(source_of("osd").ids[:2]))
    yield "check/seven_scenes unit x 10", lambda: _checked(_part("seven_scenes", 2, FAULTS["unit x 10"]))
    yield "check/seven_scenes moved pose", lambda: _checked(_part("seven_scenes", 3, lambda one: moved(one, shift=0.2)))
    yield "check/graspnet_frame unit x 0.25", lambda: _checked(_part("graspnet_frame", 1, FAULTS["unit x 0.25"]))


def cases() -> Iterator[Case]:
    """Yield ``check/capture fault``; each name of a check has a digest."""
    yield from _validations()
