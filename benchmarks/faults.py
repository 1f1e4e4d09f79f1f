"""What is broken and what it is broken in: recordings, rendered and real, and faults to inject into them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pcdata.geometry import rigid
from pcdata.io import open_source, read_depth, read_pcd, write_color, write_depth, write_pose
from pcdata.rng import seeded
from pcdata.structures import Camera, DepthFrame
from pcdata.synthetic import Miscalibration, tabletop
from pcdata.validation import CaptureLimits

DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1), (0.7071, 0.7071), (-0.7071, -0.7071))

Captures = Sequence[DepthFrame]  # of one recording, in order


@dataclass
class Recording:
    """Consecutive captures by the same cameras."""

    name: str
    frames: Captures
    limits: CaptureLimits = field(default_factory=CaptureLimits)
    checks: frozenset[str] = frozenset()  # that can be told at all; empty = every one


@dataclass
class Fault:
    name: str
    size: str
    check: str  # the one that must fail
    inject: Callable[[Captures, int], Captures | None]  # (recording, draw) -> broken; None = cannot be done to it
    draws: int = 1
    view: Callable[[int], int] | None = None  # draw -> the one view that is wrong and must be named


# -- recordings --------------------------------------------------------------------------------------------------------


def synthetic(seeds: int) -> Iterator[Recording]:
    for seed in range(seeds):
        size = (720, 1280) if seed % 4 == 3 else (480, 640)
        scene = tabletop(seed, num_objects=5 + seed % 4, num_views=3, noise="stereo", size=size)
        yield Recording(f"synthetic seed {seed}", [with_color_noise(frame) for frame in scene.noisy_frames(3)])


def with_color_noise(frame: DepthFrame) -> DepthFrame:
    """The renderer's colors are the same in every capture; a sensor's never are."""
    generator = seeded(frame.capture_index)
    noise = (2.0 * torch.randn(frame.colors.shape, generator=generator)).round()
    return replace(frame, colors=(frame.colors + noise).clamp(0, 255).byte())


def real(folder: Path) -> Iterator[Recording]:
    frames = open_source(folder / "graspnet_frame")
    yield Recording("graspnet_frame", [frames.load(name) for name in frames.ids])
    scenes = open_source(folder / "seven_scenes")
    office = CaptureLimits(workspace=(0.3, 5.0))
    for begin in range(0, 50, 10):
        recording = [scenes.load(name) for name in scenes.ids[begin : begin + 10]]
        yield Recording(f"seven_scenes {begin}", recording, office)
    yield Recording("tabletop_stream", list(stream(folder / "tabletop_stream")))
    yield Recording("pcl stereo table", [organized(folder / "pcd" / "table_scene_mug_stereo_textured.pcd")])
    for file in sorted((folder / "osd").glob("*.pcd")):
        yield Recording(f"osd {file.stem}", [organized(file)])


def stream(folder: Path) -> Iterator[DepthFrame]:
    from PIL import Image

    for file in sorted(folder.rglob("*.npy")):
        depth = torch.from_numpy(np.load(file).astype(np.float32)) / 1000
        color = file.with_name(file.name.replace("depth", "color")).with_suffix(".png")
        size = (depth.shape[0], depth.shape[1])
        camera = Camera.pinhole(fx=927.17, fy=927.37, cx=651.32, cy=349.62, size=size)
        colors = torch.from_numpy(np.array(Image.open(color).convert("RGB")))
        facts = {"metres_per_unit": 0.001}
        yield DepthFrame(depth=depth[None], camera=camera, colors=colors[None], sample_id=file.stem, provenance=facts)


def organized(file: Path) -> DepthFrame:
    """An organized cloud as the depth and color image that it was; Open3D keeps the pixels without depth too."""
    import open3d

    height, width = read_pcd(file).meta[0]["organized_size"]
    cloud = open3d.io.read_point_cloud(str(file), remove_nan_points=False)
    depth = np.nan_to_num(np.asarray(cloud.points)[:, 2]).reshape(height, width)
    colors = np.rint(255 * np.asarray(cloud.colors)).astype(np.uint8).reshape(height, width, 3)
    camera = Camera.pinhole(fx=525.0, fy=525.0, cx=319.5, cy=239.5, size=(height, width))
    return DepthFrame(
        depth=torch.from_numpy(depth).float()[None],
        camera=camera,
        colors=torch.from_numpy(colors)[None],
        sample_id=file.stem,
    )


# -- faults ------------------------------------------------------------------------------------------------------------


def every(change: Callable[[DepthFrame], DepthFrame | None]) -> Callable[[Captures, int], Captures | None]:
    """Do the same to every capture."""

    def inject(frames: Captures, draw: int) -> Captures | None:
        changed = [change(frame) for frame in frames]
        return None if any(one is None for one in changed) else changed  # type: ignore[return-value]

    return inject


def unit(factor: float) -> Fault:
    change = every(lambda frame: replace(frame, depth=frame.depth * factor))
    return Fault("depth unit", f"x{factor:g}", "depth_unit", change)


def shifted_color(pixels: int) -> Fault:
    def inject(frames: Captures, draw: int) -> Captures | None:
        if frames[0].colors is None:
            return None
        x, y = (round(pixels * part) for part in DIRECTIONS[draw])
        return [replace(frame, colors=frame.colors.roll((y, x), (1, 2))) for frame in frames]

    return Fault("color shifted", f"{pixels} px", "color_registration", inject, draws=len(DIRECTIONS))


def missing(percent: int) -> Fault:
    def inject(frames: Captures, draw: int) -> Captures:
        height, width = frames[0].size
        rows, columns = round(height * percent / 100), round(width * percent / 100)
        cut = [
            (slice(None), slice(0, columns)), (slice(None), slice(width - columns, width)),
            (slice(0, rows), slice(None)), (slice(height - rows, height), slice(None)),
        ][draw]  # fmt: skip
        broken = []
        for frame in frames:
            depth = frame.depth.clone()
            depth[:, cut[0], cut[1]] = 0.0
            broken.append(replace(frame, depth=depth))
        return broken

    return Fault("part of the frame missing", f"{percent} %", "missing_region", inject, draws=4)


def resized(scale: float) -> Fault:
    """The image was resized (here: stays as it is) and kept the intrinsics of a size ``scale`` times as large."""

    def change(frame: DepthFrame) -> DepthFrame | None:
        height, width = frame.size
        other = frame.camera.resized((round(height * scale), round(width * scale)))
        camera = replace(other, size=frame.size, is_window=False)
        return replace(frame, camera=camera)

    return Fault("intrinsics of another size", f"x{scale:g}", "principal_point", every(change))


def posed(name: str, change: Callable[[Tensor], Tensor]) -> Fault:
    def inject(frames: Captures, draw: int) -> Captures | None:
        if frames[0].world_from_camera is None:
            return None
        return [replace(frame, world_from_camera=change(frame.world_from_camera)) for frame in frames]

    return Fault("poses", name, "pose_direction", inject)


def transposed(poses: Tensor) -> Tensor:
    turned = poses.clone()
    turned[:, :3, :3] = poses[:, :3, :3].mT
    return turned


def millimetres(poses: Tensor) -> Tensor:
    longer = poses.clone()
    longer[:, :3, 3] *= 1000
    return longer


def repeated(image: str, check: str) -> Fault:
    def inject(frames: Captures, draw: int) -> Captures | None:
        if len(frames) < 2 or (image == "colors" and frames[0].colors is None):
            return None
        names = ("depth", "colors") if image == "both" else (image,)
        return [*frames, replace(frames[-1], **{name: getattr(frames[-2], name) for name in names})]

    return Fault("repeated image", image, check, inject)


def saturated(percent: float) -> Fault:
    def change(frame: DepthFrame) -> DepthFrame:
        far = frame.depth.flatten(1).sort(dim=1).values[:, -max(1, round(percent / 100 * frame.depth[0].numel()))]
        return replace(frame, depth=torch.minimum(frame.depth, far[:, None, None]))

    return Fault("range clipped", f"{percent:g} % of pixels", "saturation", every(change))


def moved(millimetre: float, degrees: float) -> Fault:
    """One of the cameras is not where its pose says."""

    def inject(frames: Captures, draw: int) -> Captures | None:
        first = frames[0]
        if first.num_views < 2 or first.world_from_camera is None:
            return None
        wrong = [0.0] * first.num_views
        wrong[draw % first.num_views] = 1.0
        error = Miscalibration(
            rotation_degrees=[degrees * one for one in wrong], translation=[1e-3 * millimetre * one for one in wrong]
        )
        return [replace(f, world_from_camera=error.apply(f.world_from_camera, draw)) for f in frames[:1]]

    size = f"{millimetre:g} mm" if millimetre else f"{degrees:g} degrees"
    return Fault("one camera moved", size, "view_pose or view_gap", inject, draws=3, view=lambda draw: draw % 3)


FAULTS = [
    *(unit(factor) for factor in (10, 100, 0.1, 0.01)),
    *(shifted_color(pixels) for pixels in (1, 2, 3, 4, 6, 8)),
    *(missing(percent) for percent in (10, 20, 30, 40, 50)),
    *(resized(scale) for scale in (0.5, 0.75, 0.8, 0.9, 1.1, 1.25, 1.5)),
    posed("inverted", rigid.invert_rigid),
    posed("rotation transposed", transposed),
    posed("OpenGL axes", lambda poses: poses @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))),
    posed("millimetres", millimetres),
    *(moved(millimetre, 0.0) for millimetre in (2, 4, 6, 10)),
    *(moved(0.0, degrees) for degrees in (0.25, 0.5, 1.0)),
    repeated("depth", "repeated_depth"),
    repeated("colors", "repeated_color"),
    repeated("both", "repeated_depth"),
    *(saturated(percent) for percent in (0.5, 2, 10)),
]


# -- faults in files ---------------------------------------------------------------------------------------------------


def store(frame: DepthFrame, folder: Path) -> None:
    """Write the first view as a folder capture with one frame."""
    for name in ("depth", "color", "poses"):
        (folder / name).mkdir(parents=True)
    write_depth(folder / "depth" / "a.png", frame.depth[0], metres_per_unit=0.001, round_to_unit=True)
    write_color(folder / "color" / "a.png", frame.colors[0])
    write_pose(folder / "poses" / "a.txt", frame.world_from_camera[0])
    (fx, _, cx), (_, fy, cy), _ = frame.camera.intrinsics[0].tolist()
    height, width = frame.size
    facts = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height, "metres_per_unit": 0.001}
    (folder / "intrinsics.json").write_text(json.dumps(facts))


def edit_calibration(folder: Path, **changes: Any) -> None:
    file = folder / "intrinsics.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def float_depth(folder: Path, change: Callable[[np.ndarray], None]) -> None:
    depth = read_depth(folder / "depth" / "a.png", metres_per_unit=0.001).numpy()
    (folder / "depth" / "a.png").unlink()
    change(depth)
    np.save(folder / "depth" / "a.npy", depth)
    edit_calibration(folder, metres_per_unit=1.0)


def mirror_pose(folder: Path) -> None:
    file = folder / "poses" / "a.txt"
    np.savetxt(file, np.loadtxt(file) @ np.diag([1.0, 1.0, -1.0, 1.0]), fmt="%.17g")


def transpose_pose(folder: Path) -> None:
    file = folder / "poses" / "a.txt"
    np.savetxt(file, np.loadtxt(file).T, fmt="%.17g")


def scale_pose(folder: Path) -> None:
    file = folder / "poses" / "a.txt"
    np.savetxt(file, np.loadtxt(file) @ np.diag([1.1, 1.1, 1.1, 1.0]), fmt="%.17g")


def truncate(folder: Path) -> None:
    file = folder / "depth" / "a.png"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def double_intrinsics(folder: Path) -> None:
    facts = json.loads((folder / "intrinsics.json").read_text())
    edit_calibration(folder, **{name: 2 * facts[name] for name in ("fx", "fy", "cx", "cy")})


def blank(folder: Path) -> None:
    from PIL import Image

    pixels = np.asarray(Image.open(folder / "depth" / "a.png"))
    Image.fromarray(np.zeros_like(pixels)).save(folder / "depth" / "a.png")


def negate(depth: np.ndarray) -> None:
    depth *= -1


def put_nan(depth: np.ndarray) -> None:
    depth[depth == 0] = np.nan


FILE_FAULTS: list[tuple[str, str, Callable[[Path], None]]] = [
    ("unit x1000 (metres for millimetres)", "depth_unit", lambda folder: edit_calibration(folder, metres_per_unit=1.0)),
    ("unit /1000", "depth_unit", lambda folder: edit_calibration(folder, metres_per_unit=1e-6)),
    ("intrinsics of an image twice as large", "intrinsics or principal_point", double_intrinsics),
    ("mirrored pose", "pose", mirror_pose),
    ("pose stored column by column", "pose", transpose_pose),
    ("pose with a scale of 1.1", "pose", scale_pose),
    ("depth file cut off", "readable", truncate),
    ("no reading at all", "valid_fraction", blank),
    ("negative depth", "raw_values", lambda folder: float_depth(folder, negate)),
    ("NaN in the file (warns)", "raw_values", lambda folder: float_depth(folder, put_nan)),
]
