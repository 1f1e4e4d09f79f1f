"""Break captures in known ways and count how often `pcdata validate` says so, and names the right fault.

    PCDATA_TEST_DATA=... python benchmarks/fault_injection.py    # prints the tables, writes results/ and docs/

Captures: rendered tabletop scenes with a stereo camera's noise, whose truth is known, and real recordings. A fault
counts as caught when the check that is made for it fails; "warned" when that check only warns. Clean captures show the
false alarms. Faults that the readers refuse are written to files and read back through `validate_source`.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pcdata.functional import edge_votes, offset_from_votes, rigid
from pcdata.io import open_source, read_pcd, write_color, write_depth, write_pose
from pcdata.report import text_table
from pcdata.rng import seeded
from pcdata.structures import Camera, DepthFrame
from pcdata.synthetic import Miscalibration, tabletop
from pcdata.validation import Check, Limits, Verdict, validate_frame, validate_source

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "fault_injection.json"
PAGE = HERE.parent / "docs" / "validation.md"
MARKS = ("<!-- fault table: made by benchmarks/fault_injection.py -->", "<!-- end of fault table -->")
DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1), (0.7071, 0.7071), (-0.7071, -0.7071))

Captures = Sequence[DepthFrame]  # of one recording, in order


@dataclass
class Recording:
    """Consecutive captures by the same cameras."""

    name: str
    frames: Captures
    limits: Limits = field(default_factory=Limits)
    checks: frozenset[str] = frozenset()  # that can be told at all; empty = every one


@dataclass
class Fault:
    name: str
    size: str
    check: str  # the one that must fail
    inject: Callable[[Captures, int], Captures | None]  # (recording, draw) -> broken; None = cannot be done to it
    draws: int = 1
    view: Callable[[int], int] | None = None  # draw -> the one view that is wrong and must be named


@dataclass
class Row:
    fault: str
    size: str
    check: str
    kind: str  # synthetic or real
    caught: int = 0
    warned: int = 0
    missed: int = 0
    named: int | None = None  # of those caught: the wrong view, and no other, failed

    @property
    def total(self) -> int:
        return self.caught + self.warned + self.missed


@dataclass
class Frames:
    """Frames in memory as something to load from."""

    frames: Captures

    @property
    def ids(self) -> list[str]:
        return [f"{position}" for position in range(len(self.frames))]

    def load(self, sample_id: str) -> DepthFrame:
        return replace(self.frames[int(sample_id)], sample_id=sample_id)


# -- recordings --------------------------------------------------------------------------------------------------------


def synthetic(seeds: int) -> Iterator[Recording]:
    for seed in range(seeds):
        size = (720, 1280) if seed % 4 == 3 else (480, 640)
        scene = tabletop(seed, num_objects=5 + seed % 4, num_views=3, noise="stereo", size=size)
        yield Recording(f"synthetic seed {seed}", [with_color_noise(frame) for frame in scene.noisy_frames(3)])


def with_color_noise(frame: DepthFrame) -> DepthFrame:
    """The renderer's colours are the same in every capture; a sensor's never are."""
    generator = seeded(frame.capture_index)
    noise = (2.0 * torch.randn(frame.colors.shape, generator=generator)).round()
    return replace(frame, colors=(frame.colors + noise).clamp(0, 255).byte())


def real(folder: Path) -> Iterator[Recording]:
    frames = open_source(folder / "graspnet_frame")
    yield Recording("graspnet_frame", [frames.load(name) for name in frames.ids])
    scenes = open_source(folder / "seven_scenes")
    office = Limits(workspace=(0.3, 5.0))
    for begin in range(0, 50, 10):
        recording = [scenes.load(name) for name in scenes.ids[begin : begin + 10]]
        yield Recording(f"seven_scenes {begin}", recording, office)
    yield Recording("tabletop_stream", list(stream(folder / "tabletop_stream")))
    yield Recording("pcl stereo table", [organised(folder / "pcd" / "table_scene_mug_stereo_textured.pcd")])
    for file in sorted((folder / "osd").glob("*.pcd")):
        yield Recording(f"osd {file.stem}", [organised(file)])


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


def organised(file: Path) -> DepthFrame:
    """An organised cloud as the depth and colour image that it was; Open3D keeps the pixels without depth too."""
    import open3d

    height, width = read_pcd(file).meta[0]["organised_size"]
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

    return Fault("colour shifted", f"{pixels} px", "color_registration", inject, draws=len(DIRECTIONS))


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
    *(shifted_color(pixels) for pixels in (1, 2, 3, 4, 6)),
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
    from pcdata.io import read_depth

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


def file_faults(frames: Captures) -> Iterator[Row]:
    from pcdata.errors import PcdataError
    from pcdata.validation import check_of_error

    for name, check, inject in FILE_FAULTS:
        row = Row("in files: " + name, "", check, "synthetic")
        for frame in frames:
            with tempfile.TemporaryDirectory() as temporary:
                folder = Path(temporary) / "capture"
                store(frame, folder)
                inject(folder)
                try:
                    source = open_source(folder)
                    found = [check for report in validate_source(source) for check in report.checks]
                except PcdataError as error:
                    found = [check_of_error(error)]
            count(row, found, check)
        yield row


# -- measuring ---------------------------------------------------------------------------------------------------------


def judge(recording: Recording, frames: Captures, check: str) -> list[Check]:
    """Run what the fault needs: the series of captures where only that can tell, else the first capture alone."""
    needs_series = check in ("repeated_depth", "repeated_color") or (
        check == "pose_direction" and frames[0].num_views == 1
    )
    if needs_series:
        reports = list(validate_source(Frames(frames), limits=recording.limits))
        return [one for report in reports for one in report.checks]
    needs_views = check.startswith("view_") or check == "pose_direction"
    return validate_frame(frames[0] if needs_views else frames[0].view(0), limits=recording.limits)


def count(row: Row, checks: Sequence[Check], name: str) -> None:
    verdicts = {check.verdict for check in checks if check.name in name.split(" or ")}
    if Verdict.FAIL in verdicts:
        row.caught += 1
    elif Verdict.WARN in verdicts:
        row.warned += 1
    else:
        row.missed += 1


def run(recordings: Sequence[Recording], kind: str) -> tuple[list[Row], Counter[str], dict[str, Counter[str]]]:
    rows = []
    alarms: dict[str, Counter[str]] = {}
    clean: Counter[str] = Counter()
    for recording in recordings:
        for report in validate_source(Frames(recording.frames), limits=recording.limits):
            clean["captures"] += report.sample_id != "*"
            for check in report.checks:
                clean["checks"] += 1
                if check.verdict is not Verdict.PASS:
                    alarms.setdefault(check.name, Counter())[
                        f"{check.verdict.value} {recording.name.split(' ')[0]}"
                    ] += 1
    for fault in FAULTS:
        row = Row(fault.name, fault.size, fault.check, kind)
        for number, recording in enumerate(recordings):
            if fault.check == "color_registration" and not registers(recording):
                continue
            for draw in range(fault.draws):
                broken = fault.inject(recording.frames, draw if fault.draws > 3 else number + draw)
                if broken is None:
                    continue
                checks = judge(recording, broken, fault.check)
                count(row, checks, fault.check)
                if fault.view is not None:
                    wrong = {one.view for one in checks if one.name == "view_pose" and one.verdict is Verdict.FAIL}
                    row.named = (row.named or 0) + (wrong == {fault.view(number + draw)})
        if row.total:
            rows.append(row)
            print(f"{kind:10s} {fault.name} {fault.size}: {row.caught}/{row.total}, warned {row.warned}", flush=True)
    return rows, clean, alarms


def registers(recording: Recording) -> bool:
    """Whether the registration of the unbroken capture is measured and good: else a shift has nothing to spoil."""
    checks = validate_frame(recording.frames[0].view(0), limits=recording.limits)
    return all(one.verdict is Verdict.PASS for one in checks if one.name == "color_registration")


def followed(recordings: Sequence[Recording], pixels: int = 3) -> dict[str, dict[str, float]]:
    """How well the measured shift follows one that is added, whatever it was before: where both can be measured."""
    errors: dict[str, list[float]] = {}
    unknown: Counter[str] = Counter()
    for recording in recordings:
        name, frame = recording.name.split(" ")[0], recording.frames[0]
        before = offset_from_votes(edge_votes(frame.depth[0], frame.colors[0]))
        for direction in DIRECTIONS:
            x, y = (round(pixels * part) for part in direction)
            after = offset_from_votes(edge_votes(frame.depth[0], frame.colors[0].roll((y, x), (0, 1))))
            if before.problem or after.problem:
                unknown[name] += 1
                continue
            off = (after.shift[0] - before.shift[0] - x, after.shift[1] - before.shift[1] - y)
            errors.setdefault(name, []).append(math.hypot(*off))
    return {
        name: {
            "measured": len(found),
            "not_measurable": unknown[name],
            "median_error_px": round(statistics.median(found), 2),
            "within_1.5_px": round(sum(one <= 1.5 for one in found) / len(found), 2),
        }
        for name, found in errors.items()
    } | {name: {"measured": 0, "not_measurable": count} for name, count in unknown.items() if name not in errors}


def speed(repeats: int = 15) -> dict[str, float]:
    """Milliseconds of wall clock and of processor time for one view of 1280x720 with colour and pose."""
    frame = tabletop(3, num_views=1, noise="stereo", size=(720, 1280)).frame
    source = Frames([frame])
    threads = torch.get_num_threads()
    walls, works = [], []
    for _ in range(repeats + 1):
        wall, work = time.perf_counter(), time.process_time()
        list(validate_source(source))
        walls.append(1e3 * (time.perf_counter() - wall))
        works.append(1e3 * (time.process_time() - work))
    return {
        "threads": threads,
        "wall_ms_median": round(statistics.median(walls[1:]), 1),
        "processor_ms_median": round(statistics.median(works[1:]), 1),
    }


# -- telling -----------------------------------------------------------------------------------------------------------


def table_of(rows: Sequence[Row]) -> list[list[str]]:
    """One line per fault and size: synthetic and real side by side."""
    lines: dict[tuple[str, str, str], dict[str, Row]] = {}
    for row in rows:
        lines.setdefault((row.fault, row.size, row.check), {})[row.kind] = row
    return [
        [fault, size, f"`{check}`", *(rate(kinds.get(kind)) for kind in ("synthetic", "real"))]
        for (fault, size, check), kinds in lines.items()
    ]


def rate(row: Row | None) -> str:
    if row is None:
        return "-"
    warned = f" (+{row.warned} warned)" if row.warned else ""
    named = "" if row.named is None else f", camera named {row.named}/{row.total}"
    return f"{row.caught}/{row.total}{warned}{named}"


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in [header, ["---"] * len(header), *rows])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=8)
    arguments = parser.parse_args()
    rows, report = [], {}
    rendered = list(synthetic(arguments.seeds))
    found, clean, alarms = run(rendered, "synthetic")
    rows += found
    report["clean_synthetic"] = {**clean, "not_passed": {name: dict(kinds) for name, kinds in alarms.items()}}
    rows += file_faults([recording.frames[0].view(0) for recording in rendered])
    if "PCDATA_TEST_DATA" in os.environ:
        recorded = list(real(Path(os.environ["PCDATA_TEST_DATA"])))
        found, clean, alarms = run(recorded, "real")
        rows += found
        report["added_shift_followed"] = followed([*rendered, *recorded])
        report["clean_real"] = {**clean, "not_passed": {name: dict(kinds) for name, kinds in alarms.items()}}
    report["speed_1280x720"] = speed()
    header = ["fault", "size", "check", "caught, synthetic", "caught, real"]
    table = table_of(rows)
    print("\n" + text_table(header, table))
    print(json.dumps(report, indent=1))
    machine = {"python": platform.python_version(), "torch": torch.__version__, "machine": platform.machine()}
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(
        json.dumps({"machine": machine, **report, "faults": [asdict(row) for row in rows]}, indent=1) + "\n"
    )
    if PAGE.exists():
        head, rest = PAGE.read_text().split(MARKS[0])
        tail = rest.split(MARKS[1])[1]
        PAGE.write_text(head + MARKS[0] + "\n\n" + markdown(header, table) + "\n\n" + MARKS[1] + tail)


if __name__ == "__main__":
    main()
