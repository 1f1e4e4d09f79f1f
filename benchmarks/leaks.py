"""Time the leak check over many stored clouds, and count which planted duplicates it finds, and what it finds wrongly.

    python benchmarks/leaks.py [--clouds 10000] [--each 50]    # results/leaks.json

Every cloud shows a table with boxes and balls of its own, from a camera of its own: 1,024 points with 1 mm of noise. Of
some in ``train``, a changed copy of each kind lies in ``test``. Kinds that must be found hold the answer of the
original; another view of a scene, a scene with one object moved, and another scene must not be called copies.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pcdata import PointCloud, build_dataset, split_dataset
from pcdata.build import config_from_yaml
from pcdata.datasets.leak_check import check_leaks

RESULTS = Path(__file__).parent / "results"
CONFIG = "output: {format: packed}"
POINTS = 1024
NOISE = 0.001  # metres, of every cloud
FOUND = ("shuffled", "half", "quarter", "noisy", "turned", "turned_any_way", "moved", "turned_half_noisy")
OTHER = ("other_view", "object_moved")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clouds", type=int, default=10_000)
    parser.add_argument("--each", type=int, default=50, help="planted of every kind")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    kinds = [*FOUND, *OTHER]
    plants = {f"{kind}/{number:04d}": kind for kind in kinds for number in range(arguments.each)}
    source = Scenes(arguments.clouds - len(plants), plants)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "set"
        begun = time.perf_counter()
        build_dataset(config_from_yaml(CONFIG), source, folder)
        built = time.perf_counter()
        table = {one: {"split": "test" if one in plants else "train"} for one in source.ids}
        split_dataset(folder, by="sample", named_by="column:split", table=table)
        split = time.perf_counter()
        report = check_leaks(folder)
        checked = time.perf_counter()
    pairs = {frozenset((leak.first, leak.second)) for leak in report.leaks}
    right = {plant: frozenset((plant, source.original(plant))) for plant in plants}
    counts = Counter(plants[plant] for plant, pair in right.items() if pair in pairs)
    wanted = {pair for plant, pair in right.items() if plants[plant] in FOUND}
    result = {
        "clouds": len(source.ids),
        "points": POINTS,
        "seconds": {"build": round(built - begun, 1), "check": round(checked - split, 1)},
        "compared": report.num_compared,
        "planted_of_each": arguments.each,
        "found": {kind: counts[kind] for kind in FOUND},
        "must_not_be_found": {kind: counts[kind] for kind in OTHER},
        "false_alarms": len(pairs - wanted),
    }
    (RESULTS / "leaks.json").write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


class Scenes:
    """So many scenes, and changed copies of some of them."""

    def __init__(self, scenes: int, plants: dict[str, str]) -> None:
        self.scenes, self.plants = scenes, plants
        self.ids = [*(f"scene/{number:06d}" for number in range(scenes)), *plants]

    def __len__(self) -> int:
        return len(self.ids)

    def original(self, plant: str) -> str:
        """Return the scene that a planted cloud was made of."""
        return f"scene/{self._number(plant):06d}"

    def _number(self, plant: str) -> int:
        return [*self.plants].index(plant) * 7 % self.scenes

    def load(self, sample_id: str) -> PointCloud:
        """Return one cloud."""
        kind = self.plants.get(sample_id)
        if kind is None:
            points = scene(int(sample_id.partition("/")[2]))
        else:
            points = changed(self._number(sample_id), kind, np.random.default_rng([1, self.ids.index(sample_id)]))
        return PointCloud(points=torch.from_numpy(points.astype(np.float32)), frame_id="base")


def scene(number: int, view: int = 0, moved: float = 0.0) -> NDArray[np.float64]:
    """Return the points of a scene that a camera sees: what is turned to it, without occlusion; (POINTS, 3) metres."""
    draw = np.random.default_rng([0, number])
    table = np.concatenate([draw.uniform(-0.4, 0.4, (3000, 2)), np.zeros((3000, 1))], 1)
    parts, normals = [table], [np.tile([0.0, 0.0, 1.0], (3000, 1))]
    for place in range(draw.integers(2, 7)):
        center = np.append(draw.uniform(-0.3, 0.3, 2), 0.0) + np.array([moved * (place == 0), 0.0, 0.0])
        size, turn = draw.uniform(0.03, 0.12, 3), Rotation.from_euler("z", draw.uniform(0, 6.28)).as_matrix()
        if draw.random() < 0.5:
            own = draw.normal(size=(2000, 3))
            own /= np.linalg.norm(own, axis=1, keepdims=True)
            parts.append(own * size[0] + center + [0, 0, size[0]])
            normals.append(own)
        else:
            own, face = draw.uniform(-1, 1, (2000, 3)), draw.integers(0, 3, 2000)
            side = np.where(draw.random(2000) < 0.5, -1.0, 1.0)
            own[np.arange(2000), face] = side
            out = np.zeros((2000, 3))
            out[np.arange(2000), face] = side
            parts.append(own * size @ turn.T + center + [0, 0, size[2]])
            normals.append(out @ turn.T)
    points, normal = np.concatenate(parts), np.concatenate(normals)
    draw = np.random.default_rng([2, number, view])
    azimuth = draw.uniform(0, 6.28)
    camera = np.array([0.8 * np.cos(azimuth), 0.8 * np.sin(azimuth), draw.uniform(0.4, 0.9)])
    points = points[((camera - points) * normal).sum(1) > 0]
    points = points[draw.choice(len(points), POINTS, replace=False)]
    return points + draw.normal(0, NOISE, points.shape)


def changed(number: int, kind: str, draw: np.random.Generator) -> NDArray[np.float64]:
    """Return a changed copy of a scene."""
    if kind == "other_view":
        return scene(number, view=1)
    if kind == "object_moved":
        return scene(number, moved=0.15)
    points = draw.permutation(scene(number))
    if "half" in kind:
        points = points[: POINTS // 2]
    if kind == "quarter":
        points = points[: POINTS // 4]
    if "noisy" in kind:
        points = points + draw.normal(0, NOISE, points.shape)
    if kind in ("turned", "turned_half_noisy"):
        points = points @ Rotation.from_euler("z", draw.uniform(0, 6.28)).as_matrix().T
    if kind == "turned_any_way":
        points = points @ Rotation.random(random_state=int(draw.integers(1 << 31))).as_matrix().T
    if kind in ("moved", "turned_any_way"):
        points = points + draw.uniform(-0.5, 0.5, 3)
    return points


if __name__ == "__main__":
    main()
