"""What is written once, built and exported for every target by ``official_loaders.py``, and what pcdata holds of it."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import pcdata
from pcdata.cli.main import main as pcdata_command
from pcdata.datasets import CachedCloudDataset
from pcdata.exports import TARGETS
from pcdata.exports.export_source import DrawnClouds
from pcdata.models import preset
from pcdata.structures import DepthFrame, PointCloud, Signal
from pcdata.synthetic import SyntheticSource, TeleopSource

CLIP = "[[-0.4, -0.4, 0.004], [0.4, 0.4, 0.5]]"  # the table left out: DemoGen takes it for the robot
CLASSES = ("bowl", "cup", "desk_lamp")


class Bench:
    """What is written once and exported to several targets."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def once(self, name: str, make: Callable[[Path], None]) -> Path:
        """Return a folder that is made the first time; one that an earlier run left serves too."""
        if not (self.folder / name).exists():
            make(self.folder / name)
        return self.folder / name

    def built(self, name: str, source: Path, *words: str) -> Path:
        """Return a dataset that ``pcdata build`` wrote."""
        return self.once(name, lambda out: run("build", *words, "--source", str(source), "--out", str(out)))

    def export(self, source: Path, target: str, *options: str) -> Path:
        """Return what ``pcdata export`` wrote."""
        given = [word for option in options for word in ("--set", option)]
        words = ("export", str(source), "--to", target, *given)
        return self.once(f"export_{target}", lambda out: run(*words, "--out", str(out)))


def run(*words: str) -> None:
    """Run one command; a failure stops everything."""
    print("  pcdata", *words, flush=True)
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = pcdata_command(list(words))
    if code:
        raise SystemExit(f"{said.getvalue()[-4000:]}\npcdata {words[0]} exited with {code}")


def write_recording(folder: Path, frames: Iterator[DepthFrame]) -> list[str]:
    """Write captures of one view as the plain layout has them; whole millimetres."""
    names = []
    for number, frame in enumerate(frames):
        name = f"{number:04d}"
        depth = (frame.depth.double() * 1000).round().div(1000).float()
        frame = replace(frame, depth=depth, provenance={"metres_per_unit": 0.001})
        with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
            pcdata.write_capture(frame, scratch)
            for path in (Path(scratch) / "view0").rglob("*"):
                if path.is_file():
                    place = folder / path.parent.relative_to(Path(scratch) / "view0")
                    place.mkdir(parents=True, exist_ok=True)
                    stem = path.name if path.name == "intrinsics.json" else f"{name}{path.suffix}"
                    shutil.move(path, place / stem)
        names.append(name)
    return names


def teleoperated(folder: Path) -> None:
    """Demonstrations with every signal that a target asks for."""
    source = TeleopSource(num_episodes=3, num_views=1, size=(360, 480))

    def frames() -> Iterator[DepthFrame]:
        for episode in source.episodes:
            ids = source.ids[episode.first : episode.first + episode.length]
            hands = [torch.tensor([source.state(name).hand]) for name in ids]
            for step, name in enumerate(ids):
                frame = source.load(name)
                motion = hands[min(step + 1, len(ids) - 1)] - hands[step]
                extra = {
                    "tcp": Signal(frame.recorded_signals["hand"].values, "pose matrix", "base"),
                    "width": Signal(torch.tensor([[0.08 if source.state(name).is_open else 0.05]]), "invariant"),
                    "place": Signal(torch.cat([hands[step], torch.zeros(1, 2)], 1), "position + invariant 2", "base"),
                    "motion": Signal(
                        torch.cat([motion, torch.full((1, 1), float(step))], 1), "displacement + invariant 1", "base"
                    ),
                    "imagin_robot": Signal(imagined(hands[step], step), "position + invariant 4", "base"),
                }
                yield replace(frame, recorded_signals={**frame.recorded_signals, **extra})

    names = write_recording(folder, frames())
    pcdata.write_episodes(folder, source.episodes, names)


def imagined(hand: torch.Tensor, step: int) -> torch.Tensor:
    """Return 96 points with four columns beside, as the robot's model would give them."""
    generator = torch.Generator().manual_seed(step)
    return torch.cat(
        [hand + 0.05 * torch.randn(96, 3, generator=generator), torch.rand(96, 4, generator=generator)], 1
    )[None]


def tabletops(folder: Path, count: int, size: tuple[int, int]) -> None:
    """Scenes of objects: labels -1 = floor, 0 = table, objects from 1 on."""
    source = SyntheticSource(num_scenes=count, size=size, num_objects=3)
    write_recording(folder, (source.load(name) for name in source.ids))


def in_parts(folder: Path) -> None:
    """Scenes whose labels are parts: two for each class, what stands on the table and the rest."""
    source = SyntheticSource(num_scenes=6, size=(120, 160), num_objects=3)
    made = enumerate(source.load(name) for name in source.ids)
    write_recording(folder, (replace(one, labels=(one.labels > 0) + 2 * (number % 3)) for number, one in made))


# -- what pcdata holds ----------------------------------------------------------------------------------------------


def clouds(built: Path, target: str) -> list[PointCloud]:
    """The clouds that an export was made from: seed 0, epoch 0; those of an episode share their draws."""
    drawn = DrawnClouds(CachedCloudDataset(built), by_episode=TARGETS[target].of_episodes)
    return [drawn.load(name) for name in drawn.ids]


def steps(built: Path, target: str, state: str, action: str, color: float | None) -> dict[str, np.ndarray]:
    """Arrays of a replay buffer, from the clouds."""
    dataset = CachedCloudDataset(built)
    made = clouds(built, target)

    def rows(names: str) -> np.ndarray:
        return np.stack([np.concatenate([one.signals[n][0].numpy() for n in names.split(",")]) for one in made])

    points = [one.points.numpy() for one in made]
    if color is not None:
        points = [np.concatenate([p, one.colors.numpy() * np.float32(color)], 1) for p, one in zip(points, made)]
    held = {"point_cloud": np.stack(points), "state": rows(state), "action": rows(action)}
    held["ends"] = np.cumsum([one.length for one in dataset.episodes])
    if "," not in action:
        held |= windows_of(dataset, action)
    return held


def windows_of(dataset: CachedCloudDataset, action: str) -> dict[str, np.ndarray]:
    """What EpisodeWindows gives of the same data, with the lengths of DP3's configuration."""
    windows = pcdata.EpisodeWindows(dataset, num_obs=2, horizon=16, num_actions=8, actions=[action])
    samples = [windows[number] for number in range(len(windows))]
    # Actions are (num_obs, horizon, D), in the coordinates of each cloud: here all in one frame.
    return {"windows_action": np.stack([one.signals[action][-1].numpy() for one in samples])}


def captures(folder: Path) -> Iterator[tuple[str, DepthFrame]]:
    """Every capture of a folder."""
    source = pcdata.open_source(folder)
    for name in source.ids:
        yield name, source.load(name)


def image_facts(folder: Path) -> dict[str, np.ndarray]:
    """Images, intrinsics and the cloud of every capture: points of pixels with depth, rows first."""
    held: dict[str, np.ndarray] = {}
    for name, frame in captures(folder):
        whole = pcdata.Deproject()(frame)
        facts = {
            "depth": frame.depth[0], "colors": frame.colors[0], "intrinsics": frame.camera.intrinsics[0],
            "points": whole.points, "point_colors": whole.colors,
        }  # fmt: skip
        if frame.labels is not None:
            facts["labels"] = frame.labels[0]
        if frame.mask is not None:
            facts["mask"] = frame.mask[0]
        if frame.world_from_camera is not None:
            facts["pose"] = frame.world_from_camera[0]
        held |= {f"{name}/{key}": value.numpy() for key, value in facts.items()}
    return held


# -- one function per target: export it and say what must come out --------------------------------------------------

Case = tuple[Path, dict[str, np.ndarray], dict[str, Any]]  # the export, what pcdata holds, and what the loader is told


def replay(
    target: str, model: str, color: float | None, state: str, action: str, *build: str
) -> Callable[[Bench], Case]:
    """Return the case of one replay buffer."""

    def case(bench: Bench) -> Case:
        source = bench.once("teleop", teleoperated)
        choices = [word for choice in build for word in ("--set", choice)]
        built = bench.built(f"built_{target}", source, "--model", model, *choices)
        out = bench.export(built, target, f"state={state}", f"action={action}")
        held = steps(built, target, state, action, color)
        if target == "dexart":
            held["imagin_robot"] = np.stack([one.signals["imagin_robot"][0].numpy() for one in clouds(built, target)])
        if target == "demogen":
            held["labels"] = np.stack([one.labels.numpy() for one in clouds(built, target)])
        return out, held, {}

    return case


def rise(bench: Bench) -> Case:
    """Poses in the camera's frame and the cloud of every step."""
    source = bench.once("teleop", teleoperated)
    out = bench.export(source, "rise", "tcp=tcp", "gripper=width")
    held = image_facts(source)
    made = preset("rise", crop=((-0.5, -0.5, 0.0), (0.5, 0.5, 1.0)))
    for name, frame in captures(source):
        cloud = made.pipeline(frame)
        held[f"{name}/voxels"] = cloud.points.numpy()
        camera_from_base = torch.linalg.inv(frame.world_from_camera[0].double())
        held[f"{name}/tcp"] = (camera_from_base @ frame.recorded_signals["tcp"].values[0].double()).numpy()
        held[f"{name}/width"] = frame.recorded_signals["width"].values[0].numpy()
    held["lengths"] = np.array([one.length for one in pcdata.open_source(source).episodes])
    return out, held, {}


def contact_graspnet(bench: Bench) -> Case:
    """Tabletops, and a real frame where there is one."""
    source = bench.once("tabletops", lambda out: tabletops(out, 3, (480, 640)))
    return bench.export(source, "contact_graspnet", "label_offset=1"), image_facts(source), {}


def graspnet(bench: Bench) -> Case:
    """The example of the repository itself, where the recordings are at hand; else tabletops."""
    real = os.environ.get("PCDATA_TEST_DATA")
    source = Path(real) / "graspnet_frame" if real else bench.once("large", lambda out: tabletops(out, 2, (720, 1280)))
    return bench.export(source, "graspnet"), image_facts(source), {"real": bool(real)}


def graspnet_scene(bench: Bench) -> Case:
    """One scene of two frames."""
    source = bench.once("large", lambda out: tabletops(out, 2, (720, 1280)))
    out = bench.export(source, "graspnet_scene", "frames_per_scene=2", "camera=realsense", "label_offset=1")
    return out, image_facts(source), {"camera": "realsense"}


def table(bench: Bench, names: list[str], splits: tuple[str, str]) -> Path:
    """A class table: classes by turns, the last two in the second split."""
    path = bench.folder / f"table_{splits[1]}.csv"
    rows = [f"{name},{CLASSES[n % 3]},{splits[n >= len(names) - 2]}" for n, name in enumerate(names)]
    path.write_text("\n".join(["sample,class,split", *rows]) + "\n", "utf-8")
    return path


def shapes(target: str, model: str, splits: tuple[str, str], *build: str) -> Callable[[Bench], Case]:
    """Return the case of a target of shapes with classes."""

    def case(bench: Bench) -> Case:
        source = bench.once("parts", in_parts)
        choices = [word for choice in build for word in ("--set", choice)]
        built = bench.built(f"built_{target}", source, "--model", model, *choices)
        names = list(CachedCloudDataset(built).ids)
        listed = table(bench, names, splits)
        out = bench.export(built, target, f"table={listed}", *(["segment=labels"] if target == "pointcept" else []))
        held: dict[str, np.ndarray] = {"names": np.array(names)}
        for number, cloud in enumerate(clouds(built, target)):
            fields = {name: value.numpy() for name, value in cloud.fields().items()}
            held |= {f"{names[number]}/{name}": value for name, value in fields.items()}
            held[f"{names[number]}/points"] = cloud.points.numpy()
            held[f"{names[number]}/class"] = np.array(number % 3)
            held[f"{names[number]}/split"] = np.array(splits[number >= len(names) - 2])
        return out, held, {"classes": CLASSES}

    return case


def ggcnn(bench: Bench) -> Case:
    """Tabletops with two grasps each."""
    source = bench.once("tabletops", lambda out: tabletops(out, 3, (480, 640)))
    grasps = bench.folder / "grasps"
    grasps.mkdir(exist_ok=True)
    held = image_facts(source)
    for number, (name, _) in enumerate(captures(source)):
        corners = np.array(
            [[[200, 180], [260, 180], [260, 205], [200, 205]], [[400, 300], [440, 340], [425, 355], [385, 315]]]
        )
        corners = corners + 7 * number
        lines = "".join(f"{x} {y}\n" for x, y in corners.reshape(-1, 2))
        (grasps / f"{name}.txt").write_text(lines, "utf-8")
        held[f"{name}/grasps"] = corners
    return bench.export(source, "ggcnn", f"grasps={grasps}"), held, {}


CASES: dict[str, Callable[[Bench], Case]] = {
    "dp3": replay(
        "dp3",
        "dp3_sim",
        255.0,
        "joints,gripper",
        "action",
        "frame=base",
        f"crop={CLIP}",
        "num_points=512",
        "channels=xyz,rgb_255",
    ),
    "dexart": replay("dexart", "dexart", None, "joints,gripper", "action", "frame=base", f"crop={CLIP}"),
    "idp3": replay(
        "idp3", "idp3", 255.0, "joints,gripper", "action", "num_points=10000", "channels=xyz,rgb_255", "crop=null"
    ),
    "maniflow": replay(
        "maniflow",
        "maniflow",
        1.0,
        "joints,gripper",
        "action",
        "frame=base",
        f"crop={CLIP}",
        "num_points=1024",
        "channels=xyz,rgb",
    ),
    "demogen": replay(
        "demogen", "demogen", None, "place", "motion", "frame=base", f"crop={CLIP}", "num_points=1024", "channels=xyz"
    ),
    "rise": rise,
    "contact_graspnet": contact_graspnet,
    "graspnet": graspnet,
    "graspnet_scene": graspnet_scene,
    "pointnet": shapes(
        "pointnet", "pointnet_cls", ("train", "test"), "frame=base", "num_points=2048", "sampler=random"
    ),
    "pointnet_part": shapes(
        "pointnet_part", "pointnet_part", ("train", "val"), "frame=base", "category=0", "num_points=2048"
    ),
    "modelnet": shapes("modelnet", "pointnet2_cls", ("train", "test"), "frame=base", "sampler=random"),
    "pointcept": shapes("pointcept", "pointcept", ("train", "val"), "frame=base"),
    "ggcnn": ggcnn,
}
