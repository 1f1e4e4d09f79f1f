"""Declare depth in every wrong unit, follow what `pcdata validate` advises, and count where that leads.

    PCDATA_TEST_DATA=... python benchmarks/unit_advice.py    # prints the table, writes results/unit_advice.json

Rendered tabletops and rooms, and real frames, are stored in each unit and declared as each. Counted for each pair: how
often the declaration passes, how often the true unit is among the named, and how often following one of them passes at
a wrong scale. The last column must be 0, and so must passes off the diagonal.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from pcdata.errors import PcdataError
from pcdata.functional.depth.stored_depth import check_plausible
from pcdata.functional.depth.unit_fit import DepthUnit, decoded, encoded
from pcdata.io import read_pcd
from pcdata.report import text_table
from pcdata.synthetic import look_at, tabletop
from pcdata.validation import CaptureLimits
from pcdata.validation.checks.depth_unit import depth_unit_check
from pcdata.verdicts import Verdict

RESULTS = Path(__file__).parent / "results" / "unit_advice.json"
UNITS = [
    DepthUnit(0.001),
    DepthUnit(0.00025),
    DepthUnit(0.0002),
    DepthUnit(0.0001),
    DepthUnit(1 / 256),
    DepthUnit(0.001, "rotated"),
    DepthUnit(0.0001, "rotated"),
    DepthUnit(1.0),
]
OPTION = re.compile(
    r"(?:metres_per_unit=|--metres-per-unit )([0-9.e-]+)(?:(?:, depth_encoding=| --depth-encoding )(\w+))?"
)
FITS = 0.3  # of the pixels must fit into 16 bits


Judgment = tuple[Verdict, str, float]  # on a declared unit, in words, and the median in metres


class Scene(NamedTuple):
    name: str
    metres: NDArray[np.float64]
    focal: float


def rendered(seeds: int) -> Iterator[Scene]:
    for seed in range(1000, 1000 + seeds):
        for noise in ("stereo", None):
            frame = tabletop(seed, num_objects=3 + seed % 7, noise=noise).frame
            yield Scene(f"table {noise}", frame.depth[0].double().numpy(), float(frame.camera.intrinsics[0, 0, 0]))
        angle, away = 0.7 * seed, 1.8 + 0.4 * (seed % 4)
        pose = look_at((away * np.cos(angle), away * np.sin(angle), 1.2))[None]
        frame = tabletop(seed, noise="stereo", world_from_camera=pose).frame
        yield Scene("room stereo", frame.depth[0].double().numpy(), float(frame.camera.intrinsics[0, 0, 0]))


def real(folder: Path) -> Iterator[Scene]:
    def png(name: str) -> NDArray[np.uint16]:
        return np.asarray(Image.open(folder / name)).astype(np.uint16)

    for number in range(0, 1000, 100):
        stored = png(f"seven_scenes/frame-{number:06d}.depth.png")
        yield Scene("seven_scenes", np.where(stored == 65535, 0, stored) / 1000.0, 585.0)
    for number in range(0, 10, 3):
        yield Scene("tabletop_stream", np.load(folder / f"tabletop_stream/depth_{number:03d}.npy") / 1000.0, 927.0)
    yield Scene("graspnet_frame", png("graspnet_frame/depth.png") / 1000.0, 631.5)
    for number in range(5):
        yield Scene("open3d_rgbd", png(f"open3d_rgbd/depth/{number:05d}.png") / 1000.0, 525.0)
    yield Scene("open3d_rgbd TUM", png("open3d_rgbd/other_formats/TUM_depth.png") / 5000.0, 525.0)
    yield Scene("open3d_rgbd SUN", decoded(png("open3d_rgbd/other_formats/SUN_depth.png"), "rotated") / 1000.0, 525.0)
    for number in range(0, 15, 3):
        stored = png(f"apc_multiview_shelf/frame-{number:06d}.depth.png")
        yield Scene("apc_shelf", decoded(stored, "rotated") / 10000.0, 615.0)
    yield Scene("gqcnn_phoxi", np.load(folder / "gqcnn_phoxi/depth_0.npy").squeeze().astype(np.float64), 1105.0)
    yield Scene("d415", png("d3roma_ir_stereo/0000_depth.png") / 1000.0, 450.0)
    for file in sorted((folder / "osd").glob("*.pcd"))[::5]:
        cloud = read_pcd(file)
        height, width = cloud.meta[0]["organized_size"]
        depth = np.zeros(height * width)
        depth[cloud.source_index.numpy()] = cloud.points[:, 2].numpy()
        yield Scene("osd", depth.reshape(height, width), 525.0)


def stored_as(metres: NDArray[np.float64], unit: DepthUnit) -> NDArray[Any] | None:
    if unit.metres == 1.0:
        return metres.astype(np.float32)
    numbers = np.rint(metres / unit.metres)
    numbers[numbers > 65535] = 0
    if (numbers > 0).mean() < FITS * (metres > 0).mean():
        return None  # too far for this unit
    return encoded(numbers.astype(np.uint16), unit.encoding)


def judge_once(
    seen: dict[DepthUnit, Judgment], stored: NDArray[Any], focal: float, limits: CaptureLimits, unit: DepthUnit
) -> Judgment:
    """Judge a unit, the first time that it is asked for."""
    if unit not in seen:
        seen[unit] = judge(stored, unit, focal, limits)
    return seen[unit]


def judge(stored: NDArray[Any], unit: DepthUnit, focal: float, limits: CaptureLimits) -> Judgment:
    """Return the verdict on a declared unit, the words, and the median in metres."""
    if stored.dtype != np.uint16 and unit.encoding != "plain":
        return Verdict.FAIL, "", float("nan")  # refused by the reader: floats have no order of bits
    metres = (decoded(stored, unit.encoding).astype(np.float64) * unit.metres).astype(np.float32)
    try:
        check_plausible("benchmark", metres, unit, stored)
    except PcdataError as error:
        return Verdict.FAIL, str(error), float("nan")
    facts = {"metres_per_unit": unit.metres, "depth_encoding": unit.encoding}
    check = depth_unit_check(torch.from_numpy(metres), limits, facts, focal=focal)
    return check.verdict, f"{check.found}; {check.advice}", check.value or float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=4)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    scenes = list(rendered(arguments.seeds))
    if "PCDATA_TEST_DATA" in os.environ:
        scenes += real(Path(os.environ["PCDATA_TEST_DATA"]))
    counts: dict[tuple[str, str, str], Counter[str]] = {}
    wrong = []
    for scene in scenes:
        limits = CaptureLimits(workspace=(0.3, 6.0)) if scene.name.startswith(("room", "seven")) else CaptureLimits()
        for true in UNITS:
            stored = stored_as(scene.metres, true)
            if stored is None or not (stored > 0).any():
                continue
            median = float(np.median(decoded(stored, true.encoding)[stored > 0])) * true.metres
            seen: dict[DepthUnit, Judgment] = {}
            judged = functools.partial(judge_once, seen, stored, scene.focal, limits)
            for declared in UNITS:
                verdict, words, found = judged(declared)
                if not words:
                    continue
                is_right = abs(found / median - 1) < 0.02
                named = [DepthUnit(float(one), order or "plain") for one, order in OPTION.findall(words)]
                tally = counts.setdefault((scene.name, str(true), str(declared)), Counter())
                tally["scenes"] += 1
                tally[verdict.value] += 1
                tally["true unit named"] += is_right or true in named
                tally["passes at a wrong scale"] += verdict is Verdict.PASS and not is_right
                for advised in named:
                    follows, _, leads_to = judged(advised)
                    if follows is Verdict.PASS and not abs(leads_to / median - 1) < 0.02:
                        tally["advice passes at a wrong scale"] += 1
                        wrong.append((scene.name, str(true), str(declared), str(advised), leads_to, median))
    columns = ["scenes", "pass", "warn", "fail", "true unit named", "passes at a wrong scale"]
    columns.append("advice passes at a wrong scale")
    rows = [[*key, *(tally[column] for column in columns)] for key, tally in counts.items()]
    is_same = [row for row in rows if row[1] == row[2]]
    print(text_table(["scene", "stored in", "declared", *columns], is_same))
    others = Counter[str]()
    for key, tally in counts.items():
        if key[1] != key[2]:
            others.update(tally)
    print("\ndeclared as another:", dict(others))
    print("wrong:", *wrong, sep="\n  ")
    unnamed = [key for key, tally in counts.items() if tally["true unit named"] < tally["scenes"]]
    print("true unit not named:", *unnamed, sep="\n  ")
    RESULTS.write_text(
        json.dumps(
            {
                "declared_as_another": others,
                "rows": [dict(zip(["scene", "stored", "declared", *columns], row)) for row in rows],
            },
            indent=1,
        )
        + "\n"
    )


if __name__ == "__main__":
    main()
