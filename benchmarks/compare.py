"""Does ``pcdata compare`` name what differs, nothing else, and nothing where nothing does?

    python benchmarks/compare.py [--same 50]     # 10 minutes on one core; writes results/compare.json and the page

Synthetic tables in two sources that differ in one thing that is known; then pairs that differ in nothing, half of them
random halves of one source.
"""

from __future__ import annotations

import argparse
import functools
import json
import platform
import re
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from pcdata.rng import generator_for
from pcdata.structures import Camera, DepthFrame
from pcdata.synthetic import SyntheticSource, tabletop
from pcdata.synthetic.viewpoints import look_at
from pcdata.transforms import (
    Compose,
    CropCenter,
    CropWorkspace,
    Deproject,
    MaskDepth,
    RandomJitter,
    RandomSensorNoise,
    RandomTranslation,
    ToFrame,
    Transform,
    VoxelDownsample,
)
from pcdata.validation.comparison import Comparison, compare_sources

RESULT = Path(__file__).parent / "results" / "compare.json"
PAGE = Path(__file__).parents[1] / "docs" / "compare.md"
MARKS = "<!-- compare table -->", "<!-- end of compare table -->"
SIZE = HEIGHT, WIDTH = 240, 320
COUNT = 12
EYE = (0.0, -0.75, 0.65)
Make = Callable[[Any, str], Any]


class Source:
    """Captures in memory."""

    def __init__(self, name: str, captures: list[Any], ids: list[str]) -> None:
        self.name, self.ids = name, ids
        self._captures = dict(zip(ids, captures))

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id: str) -> Any:
        return self._captures[sample_id]

    def through(self, make: Make, name: str = "made") -> Source:
        """The same captures after a function of capture and id."""
        return Source(name, [make(self.load(one), one) for one in self.ids], self.ids)

    def half(self, which: list[int]) -> Source:
        """Some of the captures."""
        ids = [self.ids[place] for place in sorted(which)]
        return Source(self.name, [self.load(one) for one in ids], ids)


class LaterScaled(Source):
    """Captures whose depth is read in a unit that no depth is in."""

    def load(self, sample_id: str) -> Any:
        frame = super().load(sample_id)
        return replace(frame, depth=frame.depth * 1000)


def step(transform: Transform) -> Make:
    """What a step makes of captures; random ones draw by the id."""
    if transform.is_random:
        return lambda capture, sample_id: transform(capture, generator=generator_for(7, 3, sample_id))
    return lambda capture, _: transform(capture)


@functools.lru_cache(maxsize=6)
def wandering(seed: int, count: int = COUNT, **options: Any) -> Source:
    """Another table and another camera in every capture."""
    made = SyntheticSource(num_scenes=count, seed=seed, size=SIZE, **options)
    return Source("tables", [made.load(one) for one in made.ids], made.ids)


@functools.lru_cache(maxsize=6)
def standing(
    seed: int, eye: tuple[float, float, float] = EYE, count: int = COUNT, size: tuple[int, int] = SIZE, **options: Any
) -> Source:
    """Another table in every capture, one camera."""
    focal = 0.96 * size[1]
    camera = Camera.pinhole(fx=focal, fy=focal, cx=(size[1] - 1) / 2, cy=(size[0] - 1) / 2, size=size)
    options = {"camera": camera, **options}
    frames = [tabletop(seed + n, world_from_camera=look_at(eye)[None], **options).frame for n in range(count)]
    return Source("stand", frames, [str(frame.sample_id) for frame in frames])


def moved(x: float, y: float, z: float) -> Make:
    """Poses that lie elsewhere, by metres, in their frame."""

    def make(frame: DepthFrame, _: str) -> DepthFrame:
        poses = frame.world_from_camera
        assert poses is not None
        poses = poses.clone()
        poses[:, :3, 3] += torch.tensor([x, y, z], dtype=torch.float64)
        return replace(frame, world_from_camera=poses)

    return make


def darker(frame: DepthFrame, _: str) -> DepthFrame:
    """Seven tenths of the brightness."""
    assert frame.colors is not None
    return replace(frame, colors=(frame.colors.float() * 0.7).to(torch.uint8))


def torn(frame: DepthFrame, sample_id: str) -> DepthFrame:
    """A hole of 40 x 40 pixels."""
    draw = torch.rand(2, generator=generator_for(1, 0, sample_id)).tolist()
    top, left = int(draw[0] * 180) + 5, int(draw[1] * 260) + 5
    depth = frame.depth.clone()
    depth[:, top : top + 40, left : left + 40] = 0
    return replace(frame, depth=depth)


def longer(times: float) -> Make:
    """All lengths of depth or of a cloud times a factor."""
    scale = torch.diag(torch.tensor([times, times, times, 1.0], dtype=torch.float64))

    def make(capture: Any, _: str) -> Any:
        if isinstance(capture, DepthFrame):
            return replace(capture, depth=capture.depth * times)
        return capture.transformed(scale[None])

    return make


def renamed(frame: DepthFrame, _: str) -> DepthFrame:
    """Poses in a frame of another name."""
    return replace(frame, frame_id="world")


CLOUDS = Compose([Deproject(), ToFrame(frame="base"), VoxelDownsample(voxel_size=0.004)])


def cases() -> dict[str, tuple[Callable[[], tuple[Source, Source]], set[str]]]:
    """Name -> how both sources are made, and what must be named."""
    box = CropWorkspace(frame="base", lower=(-0.35, -0.3, -0.02), upper=(0.35, 0.3, 0.3))
    large = CropWorkspace(frame="base", lower=(-0.6, -0.4, -0.1), upper=(0.6, 0.4, 0.6))
    noise = RandomSensorNoise(sensor="realsense_d435")
    offset = RandomTranslation(min_offset=(0.0, 0.0, 0.02), max_offset=(0.0, 0.0, 0.02))

    def clouds(seed: int) -> Source:
        return wandering(seed).through(step(CLOUDS)).through(step(large))

    all_noise = {"noise", "holes", "flying pixels"}
    return {
        "RandomSensorNoise(realsense_d435)": (lambda: (wandering(0), wandering(100).through(step(noise))), all_noise),
        "RandomSensorNoise(azure_kinect_nfov)": (
            lambda: (wandering(0), wandering(100).through(step(RandomSensorNoise(sensor="azure_kinect_nfov")))),
            {"noise", "holes"},  # flying pixels are within a noise of 16 mm
        ),
        "noise twice as strong in A": (
            lambda: (
                wandering(0).through(step(RandomSensorNoise(sensor="realsense_d435", strength=2.0))),
                wandering(100).through(step(noise)),
            ),
            {"noise"},
        ),
        "poses 20 mm higher": (lambda: (wandering(0), wandering(100).through(moved(0, 0, 0.02))), {"offset"}),
        "poses 20 mm aside and 20 mm higher, one camera": (
            lambda: (standing(0), standing(100).through(moved(0.02, 0, 0.02))),
            {"offset"},
        ),
        "depth in tenths": (lambda: (wandering(0), wandering(100).through(longer(0.1))), {"unit"}),
        "depth of 1/5000 m read as mm": (lambda: (wandering(0), wandering(100).through(longer(5.0))), {"unit"}),
        "depth in mm read as metres": (
            lambda: (
                wandering(0),
                (lambda one: LaterScaled("mm", [one.load(i) for i in one.ids], one.ids))(wandering(100)),
            ),
            {"unit"},
        ),
        "camera 20 mm higher": (lambda: (standing(0), standing(100, (0.0, -0.75, 0.67))), {"camera"}),
        "camera aside, turned": (lambda: (standing(0), standing(100, (0.15, -0.73, 0.65))), {"camera"}),
        "depth cut off at 1.2 m": (lambda: (wandering(0), wandering(100).through(step(MaskDepth(far=1.2)))), {"crop"}),
        "9 objects, not 4": (lambda: (wandering(0, num_objects=4), wandering(100, num_objects=9)), {"objects"}),
        "seven tenths of the brightness": (lambda: (wandering(0), wandering(100).through(darker)), {"colors"}),
        "half the resolution": (lambda: (standing(0), standing(100, size=(120, 160))), {"image size"}),
        "window of 200 x 260 pixels": (
            lambda: (standing(0), standing(100).through(step(CropCenter(size=(200, 260))))),
            {"image size"},
        ),
        "a hole of 40 x 40 pixels": (lambda: (wandering(0), wandering(100).through(torn)), {"holes"}),
        "another name of the frame": (lambda: (wandering(0), wandering(100).through(renamed)), {"frame"}),
        "noise, poses 20 mm higher and depth in tenths": (
            lambda: (
                wandering(0),
                wandering(100).through(step(noise)).through(longer(0.1)).through(moved(0, 0, 0.02)),
            ),
            {*all_noise, "unit", "offset"},
        ),
        "clouds 20 mm higher": (lambda: (clouds(0), clouds(100).through(step(offset))), {"offset"}),
        "clouds in a smaller box": (lambda: (clouds(0), clouds(100).through(step(box))), {"crop"}),
        "clouds in mm": (lambda: (clouds(0), clouds(100).through(longer(1e3))), {"unit"}),
        "clouds of larger voxels": (
            lambda: (clouds(0), clouds(100).through(step(VoxelDownsample(voxel_size=0.008)))),
            {"density"},
        ),
        "clouds with jitter of 2 mm": (
            lambda: (clouds(0), clouds(100).through(step(RandomJitter(sigma=0.002)))),
            {"noise"},
        ),
        "clouds against captures": (
            lambda: (wandering(0).through(step(Compose([Deproject(), ToFrame(frame="base")]))), wandering(100)),
            set(),
        ),
    }


def told(result: Comparison) -> dict[str, Any]:
    """What a result says, for the table."""
    return {
        "verdict": str(result.verdict),
        "named": sorted({one.name for one in result.differences}),
        "closed": sorted({one.name for one in result.differences if one.closed}),
        "steps": [one.step for one in result.differences if one.step],
        "found": [f"{one.name}: {one.found}" for one in result.differences],
    }


def followed(result: Comparison, a: Source, b: Source) -> dict[str, Any] | None:
    """Follow the advice as a user does, with other draws, and compare again; None where no step was named."""
    sides = {"A": a, "B": b}
    done = set()
    units = [one for one in result.differences if one.name == "unit" and one.closed]
    for one in units:
        letter, times = re.search(r"read ([AB]) with .* times ([0-9.e+-]+):", one.advice).groups()  # type: ignore[union-attr]
        sides[letter] = sides[letter].through(longer(float(times)))
        done.add(one.advice)
    for one in sorted(result.differences, key=lambda one: one.name == "offset"):  # clouds come after depth images
        if not one.step or str(one.step) in done:
            continue
        done.add(str(one.step))
        transform = Compose.from_config([one.step]) if not isinstance(one.step, Transform) else one.step
        is_frame = isinstance(sides[one.on].load(sides[one.on].ids[0]), DepthFrame)
        if is_frame and one.name == "offset":  # of clouds, after ToFrame: both sources as clouds
            clouds = step(Compose([Deproject(), ToFrame(frame="base")]))
            sides = {letter: source.through(clouds) for letter, source in sides.items()}
        sides[one.on] = sides[one.on].through(
            lambda capture, sample_id, transform=transform: transform(
                capture, generator=generator_for(99, 1, sample_id)
            )
        )
    return (
        {"named": sorted({one.name for one in compare_sources(sides["A"], sides["B"]).differences})} if done else None
    )


def without_difference(pairs: int) -> list[dict[str, Any]]:
    """Pairs of which nothing should be named: every second pair are halves of one source."""
    makers: list[Callable[[int, int], Source]] = [
        lambda seed, count: wandering(seed, count),
        lambda seed, count: standing(seed, count=count, noise="stereo"),
        lambda seed, count: wandering(seed, count).through(step(RandomSensorNoise(sensor="realsense_d435"))),
        lambda seed, count: wandering(seed, count).through(step(CLOUDS)),
    ]
    rows = []
    for number in range(pairs):
        make = makers[(number // 2) % len(makers)]
        count = (6, 12, 24)[number % 3]
        if number % 2:
            source = make(1000 * number, 2 * count)
            order = torch.randperm(2 * count, generator=torch.Generator().manual_seed(number)).tolist()
            a, b = source.half(order[:count]), source.half(order[count:])
        else:
            a, b = make(1000 * number, count), make(1000 * number + 500, count)
        result = told(compare_sources(a, b))
        rows.append({"pair": number, "captures": count, "halves": bool(number % 2), **result})
        print(rows[-1]["pair"], rows[-1]["verdict"], rows[-1]["found"], flush=True)
    return rows


def table(result: dict[str, Any]) -> str:
    """The table of docs/compare.md."""

    def words(names: list[str]) -> str:
        return ", ".join(names) or "nothing"

    lines = ["| B differs from A by | named | after the advice |", "|---|---|---|"]
    for row in result["cases"]:
        after = "" if row["after_advice"] is None else words(row["after_advice"]["named"])
        lines.append(f"| {row['case']} | {words(row['named'])} | {after} |")
    same = result["same"]
    lines.append(f"| nothing | {len(same['alarms'])} alarms in {same['pairs']} | |")
    return "\n".join(lines)


def write_page() -> None:
    """Put the table of the kept result into docs/compare.md."""
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(MARKS[0])
    kept = json.loads(RESULT.read_text(encoding="utf-8"))
    PAGE.write_text(f"{before}{MARKS[0]}\n{table(kept)}\n{MARKS[1]}{rest.split(MARKS[1])[1]}", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--same", type=int, default=50, help="pairs that differ in nothing")
    parser.add_argument("--only", help="cases whose name holds this; nothing is written then")
    parser.add_argument("--kept", action="store_true", help="write the page from results/compare.json alone")
    arguments = parser.parse_args()
    if arguments.kept:
        write_page()
        return
    torch.set_num_threads(1)
    begun = time.process_time()
    rows = []
    for name, (make, expected) in cases().items():
        if arguments.only and arguments.only not in name:
            continue
        a, b = make()
        start = time.process_time()
        result = compare_sources(a, b)
        seconds = time.process_time() - start
        rows.append(
            {
                "case": name,
                "expected": sorted(expected),
                **told(result),
                "after_advice": followed(result, a, b),
                "cpu_seconds": round(seconds, 2),
            }
        )
        row = rows[-1]
        right = row["named"] == row["expected"]
        print("ok " if right else "NOT", name, row["named"], row["after_advice"], row["cpu_seconds"], flush=True)
        if not right or arguments.only:
            print(result.text())
    if arguments.only:
        return
    same = without_difference(arguments.same)
    alarms = [row for row in same if row["named"]]
    RESULT.write_text(
        json.dumps(
            {
                "benchmark": "compare",
                "machine": platform.machine(),
                "captures": COUNT,
                "cases": rows,
                "right": sum(row["named"] == row["expected"] for row in rows),
                "same": {"pairs": len(same), "alarms": alarms},
                "cpu_seconds": round(time.process_time() - begun, 1),
            },
            indent=1,
        )
        + "\n"
    )
    write_page()
    right = sum(row["named"] == row["expected"] for row in rows)
    print(f"{right} of {len(rows)} right; {len(alarms)} alarms in {len(same)}")


if __name__ == "__main__":
    main()
