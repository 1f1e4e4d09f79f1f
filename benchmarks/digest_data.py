"""Digests of what loaders give, of whole chains, of every model's batch, and of every export."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import digest_names as its
import numpy as np
import torch
from digest_files import CONFIG, captures, dataset, files_of
from digest_hash import Many
from digest_inputs import Samples, base_cloud, pose, rendered, scratch, seeded
from digest_real import real_folder, real_frame
from torch.utils.data import DataLoader, RandomSampler

Case = tuple[str, Callable[[], Any]]

# -- loaders -----------------------------------------------------------------------------------------------------------

FIXED = CONFIG.replace("augment: [", "augment: [RandomSample: {num_points: 64, if_short: repeat}, ").replace(
    ", RandomPointDropout: {low: 0.1, high: 0.3}", ""
)


def _batches(data: Any, collate: str, *, epochs: int = 2, workers: int = 0, sampler: Any = None) -> Many:
    """Every batch of some epochs."""
    found = {}
    for epoch in range(epochs):
        data.set_epoch(epoch)
        given = {"sampler": sampler} if sampler is not None else {"shuffle": True, "generator": seeded(epoch)}
        loader = DataLoader(data, batch_size=2, num_workers=workers, collate_fn=getattr(its.pcdata, collate), **given)
        found[f"epoch {epoch}"] = list(loader)
    return Many(found)


def _on_the_fly(text: str = CONFIG, **options: Any) -> Any:
    return its.pcdata.CloudDataset(captures(), its.pipeline(text), **options)


def _cached(**options: Any) -> Any:
    return its.pcdata.CachedCloudDataset(dataset(), **options)


def _counted() -> Many:
    data = _cached(seed=3)
    sampler = its.pcdata.CountedSampler(RandomSampler(data, replacement=True, num_samples=7, generator=seeded(1)))
    return _batches(data, "collate_packed", epochs=1, sampler=sampler)


def _loaders() -> Iterator[Case]:
    for collate in ("collate_packed", "collate_padded"):
        yield f"loader/fly/{collate}", lambda collate=collate: _batches(_on_the_fly(), collate)
        yield f"loader/cached/{collate}", lambda collate=collate: _batches(_cached(), collate)
    yield "loader/fly/collate_fixed", lambda: _batches(_on_the_fly(FIXED), "collate_fixed")
    yield "loader/fly/seed and repeats", lambda: _batches(_on_the_fly(seed=5, repeats=2), "collate_packed")
    yield "loader/cached/seed and repeats", lambda: _batches(_cached(seed=5, repeats=2), "collate_packed")
    yield "loader/cached/worker", lambda: _batches(_cached(seed=5), "collate_packed", epochs=1, workers=1)
    yield "loader/cached/counted", _counted
    synthetic = its.SyntheticSource(num_scenes=2, num_objects=2, size=(24, 32), noise="stereo")
    yield "loader/synthetic", lambda: [synthetic.load(name) for name in synthetic.ids]


# -- chains -----------------------------------------------------------------------------------------------------------

CONFIGS = Path(__file__).parents[1] / "configs"


def _chain(name: str, capture: Any) -> Any:
    """A capture through the depth, cloud and augment sections of one of the examples in configs/."""
    return its.run(its.pipeline((CONFIGS / f"{name}.yaml").read_text(encoding="utf-8")), capture, 3)


def _chains() -> Iterator[Case]:
    policy, glass, views = "tabletop_policy", "transparent_objects", "multiview_objects"
    yield f"chain/{policy}/rendered", lambda: _chain(policy, rendered(1, 3, (240, 320)))
    yield f"chain/{glass}/rendered", lambda: _chain(glass, rendered(1, 3, (240, 320)))
    yield f"chain/{views}/rendered two", lambda: _chain(views, rendered(2, 3, (240, 320)))
    yield "chain/small/clouds enter at cloud", lambda: its.run(its.pipeline(CONFIG), base_cloud(), 4)
    if real_folder() is None:
        return
    for name in ("graspnet_frame", "seven_scenes", "osd"):
        yield f"chain/{policy}/{name}", lambda name=name: _chain(policy, real_frame(name))
    yield f"chain/{glass}/graspnet_frame", lambda: _chain(glass, real_frame("graspnet_frame"))


# -- models ------------------------------------------------------------------------------------------------------------

TABLE = {"frame": "base", "crop": ((-0.3, -0.3, -0.05), (0.3, 0.3, 0.6)), "category": 3, "scale": 4.0}
ROOM = {"frame": "camera", "crop": ((-2.0, -2.0, 0.1), (2.0, 2.0, 3.0)), "category": 3, "scale": 0.5}


def _choices(name: str, answers: dict[str, Any]) -> dict[str, Any]:
    return {choice: answers[choice] for choice in its.open_choices(name)}


def _table_batch(name: str) -> Any:
    size = (480, 640) if its.takes_images(name) else (240, 320)
    frames = [rendered(1, seed, size) for seed in (3, 4)]
    return its.model_batch(name, _choices(name, TABLE), frames)


def _real_batch(name: str) -> Any:
    frame = real_frame("graspnet_frame")
    frame = frame if its.takes_images(name) else its.run(its.step("DecimateDepth", factor=4), frame)
    return its.model_batch(name, _choices(name, ROOM), [frame])


def _models() -> Iterator[Case]:
    for name in its.contract_names():
        yield f"model/{name}/synthetic two", lambda name=name: _table_batch(name)
        if real_folder() is not None:
            yield f"model/{name}/graspnet", lambda name=name: _real_batch(name)


# -- exports -----------------------------------------------------------------------------------------------------------


def _cloud(count: int, seed: int, **changes: Any) -> Any:
    """Points in the unit sphere with colors of 8 bits, normals and labels."""
    generator = seeded(seed)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    fields: dict[str, Any] = {
        "points": direction * torch.rand(count, 1, generator=generator),
        "frame_id": "base",
        "colors": torch.randint(256, (count, 3), generator=generator).float() / 255,
        "normals": direction,
        "labels": torch.arange(count) % 4,
    }
    return its.PointCloud(**(fields | changes))


def _view(size: tuple[int, int], seed: int) -> Any:
    """A view in whole millimetres with one hole, color, a mask, labels -1, 1 and 2, and a pose."""
    generator, (height, width) = seeded(seed), size
    units = torch.randint(400, 900, (1, height, width), generator=generator)
    units[0, 1, 2] = 0
    labels = torch.full((1, height, width), -1)
    labels[0, : height // 2, : width // 2] = 1
    labels[0, height // 2 :, width // 2 :] = 2
    return its.DepthFrame(
        depth=(units.double() * 0.001).float(),
        camera=its.Camera.pinhole(fx=20.5, fy=21.25, cx=width / 2 - 0.75, cy=height / 2 + 0.5, size=size),
        colors=torch.randint(256, (1, height, width, 3), generator=generator, dtype=torch.uint8),
        mask=torch.rand(1, height, width, generator=generator) > 0.3,
        labels=labels,
        world_from_camera=pose(seed)[None],
        frame_id="table",
        provenance={"metres_per_unit": 0.001},
    )


NAMES = ("a", "b", "c")
SPLITS = {
    name: {"class": "mug" if name < "c" else "bowl", "split": "train" if name < "c" else "test"} for name in NAMES
}


def _shapes(count: int) -> Samples:
    return Samples({name: its.run(its.step("NormalizeUnitSphere"), _cloud(count, n)) for n, name in enumerate(NAMES)})


def _robot() -> dict[str, Any]:
    number = np.random.default_rng(1)
    lengths = {"one": NAMES[:2], "two": NAMES[2:]}
    return {
        name: {"samples": np.array(ids), "state": number.random((len(ids), 7)), "action": number.random((len(ids), 4))}
        for name, ids in lengths.items()
    }


class _Recording(Samples):
    """Samples with signals, of two episodes."""

    def __init__(self, samples: dict[str, Any]) -> None:
        super().__init__({name: _with_robot(one, n) for n, (name, one) in enumerate(samples.items())})
        self.episodes = [its.Episode("one", 0, 2), its.Episode("two", 2, 1)]

    def __len__(self) -> int:
        return len(self.ids)


def _with_robot(one: Any, number: int) -> Any:
    frame = one.frame_id
    tcp = torch.tensor([[0.1 * number, 0.2, 0.3, 0.6, 0.0, 0.8, 0.0]], dtype=torch.float64)
    one = one.with_signal("tcp", tcp, "pose xyz_quat_wxyz", frame)
    one = one.with_signal("state", torch.tensor([[0.1, 0.2 * number, 0.3]]), "position", frame)
    one = one.with_signal("action", torch.tensor([[0.0, 0.1, 0.1 * number]]), "displacement", frame)
    one = one.with_signal("gripper", torch.tensor([[0.01 * number]]), "invariant")
    robot = torch.linspace(0, 1, 96 * 7).reshape(1, 96, 7)
    return one.with_signal("imagin_robot", robot, "position + invariant 4", frame)


def _exported(target: str) -> Many:
    ahead = torch.tensor([0.0, 0.0, 0.6])
    steps = {name: _cloud(1024, n) for n, name in enumerate(NAMES)}
    before = {name: _cloud(10_000, n, frame_id="camera") for n, name in enumerate(NAMES)}
    before = {name: replace(one, points=0.3 * one.points + ahead) for name, one in before.items()}
    still = {name: replace(_view((24, 32), n), world_from_camera=pose(1)[None]) for n, name in enumerate(NAMES)}
    clouds = Samples({name: _cloud(512, n) for n, name in enumerate(NAMES)})
    views = Samples({name: _view((24, 32), n) for n, name in enumerate(NAMES)})
    plans: dict[str, tuple[Any, dict[str, Any]]] = {
        "dp3": (clouds, {"episodes": _robot()}),
        "dexart": (_Recording(steps), {}),
        "idp3": (_Recording(before), {}),
        "maniflow": (_Recording(steps), {"next_state": True}),
        "demogen": (_Recording(steps), {}),
        "diffusion_policy": (_Recording(steps), {}),
        "rise": (_Recording(still), {}),
        "pointnet": (_shapes(2048), {"table": SPLITS}),
        "pointnet_part": (_shapes(2048), {"table": {**SPLITS, "c": {"class": "mug", "split": "val"}}}),
        "modelnet": (_shapes(1100), {"table": SPLITS}),
        "pointcept": (clouds, {"table": SPLITS, "segment": "labels"}),
        "contact_graspnet": (views, {}),
        "graspnet": (views, {"any_size": True}),
        "graspnet_scene": (views, {"any_size": True, "frames_per_scene": 3}),
        "ggcnn": (views, {"any_size": True}),
    }
    source, options = plans[target]
    folder = scratch("exports") / target
    its.export(source, target, folder, **options)
    files = files_of(folder, leave_out=("pcdata_export.json",))
    return Many({name: _content(name, data) for name, data in sorted(files.items())})


def _content(name: str, data: bytes) -> Any:
    """The arrays of a container that may hold the time it was written; of another file, its bytes."""
    suffix = Path(name).suffix
    if suffix == ".npz":
        with np.load(io.BytesIO(data), allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files if stored[key].dtype.kind in "biuf"}
    if suffix == ".h5":
        import h5py

        with h5py.File(io.BytesIO(data), "r") as stored:
            return {key: stored[key][()] for key in stored}
    if suffix == ".mat":
        from scipy.io import loadmat

        return {key: value for key, value in loadmat(io.BytesIO(data)).items() if not key.startswith("__")}
    return data


def _built_export() -> Many:
    """An export of what a build stored."""
    built, folder = scratch("datasets/merged") / "dataset", scratch("exports") / "built"
    its.build(CONFIG.replace("- EstimateNormals", "- MergeViews\n  - EstimateNormals"), captures(), built)
    its.export(str(built), "pointcept", folder)
    files = files_of(folder, leave_out=("pcdata_export.json",))
    return Many({name: _content(name, data) for name, data in sorted(files.items())})


def _exports() -> Iterator[Case]:
    for target in its.export_names():
        yield f"export/{target}", lambda target=target: _exported(target)
    yield "export/pointcept of a build", _built_export


def cases() -> Iterator[Case]:
    """Yield ``loader/...``, ``chain/CONFIG/input``, ``model/NAME/input`` and ``export/TARGET``."""
    yield from _loaders()
    yield from _chains()
    yield from _models()
    yield from _exports()
