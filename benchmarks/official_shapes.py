"""Shapes with classes and scenes of points with the loaders of PointNet, PointNet++ and Pointcept."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
import types
from unittest.mock import MagicMock

import numpy as np


class Session:
    """Stands in for a TensorFlow session: notes what the training loop feeds, and gives numbers of the right shapes."""

    def __init__(self, results: dict[int, object]) -> None:
        self.fed: list[list[np.ndarray]] = []
        self.results, self.graph = results, None

    def run(self, fetches, feed_dict=None):
        arrays = [value for value in (feed_dict or {}).values() if isinstance(value, np.ndarray)]
        if arrays:
            self.fed.append(arrays)
        return [self.results.get(id(one), 0.0) for one in fetches] if isinstance(fetches, list) else 0.0


def tensorflow(run, session: Session) -> None:
    """Replace TensorFlow: the loops around the network run, the network does not."""
    (tf,) = run.stub("tensorflow", always=True)
    tf.compat.v1.placeholder = lambda *_, **__: MagicMock()
    tf.compat.v1.Session = lambda **_: session


def laid(run, *scripts: str, data: str):
    """Return a folder with links to the scripts and the export where they look for their data."""
    root = run.scratch / "repository"
    for script in scripts:
        place = root / script
        place.parent.mkdir(parents=True, exist_ok=True)
        if not place.exists():
            place.symlink_to(run.checkouts / run.told.get("repository", "pointnet") / script)
    place = root / data
    place.parent.mkdir(parents=True, exist_ok=True)
    if not place.exists():
        place.symlink_to(run.export)
    return root


@contextlib.contextmanager
def inside(folder, *words: str):
    """Work in a folder as if a script had been called with these words."""
    before, where = sys.argv[:], os.getcwd()
    os.chdir(folder)
    sys.argv[1:] = words
    try:
        yield
    finally:
        sys.argv[:] = before
        os.chdir(where)


def by_split(run, split: str) -> list[str]:
    return [name for name in run.names() if str(run.truth[f"{name}/split"]) == split]


def pointnet(run) -> None:
    """The whole of train.py, for one epoch, with a session that notes what it is fed."""
    size = 2
    answers = {}
    session = Session(answers)
    tensorflow(run, session)
    model, _ = run.stub("pointnet_cls", "tf_util", always=True)
    answers[id(model.get_model.return_value)] = None
    prediction = np.zeros((size, 40))
    predicted = MagicMock()
    answers[id(predicted)] = prediction
    model.get_model.return_value = (predicted, MagicMock())
    model.placeholder_inputs.return_value = (MagicMock(), MagicMock())
    root = laid(run, "provider.py", "train.py", data="data/modelnet40_ply_hdf5_2048")
    sys.path.insert(0, str(root))
    with inside(root, "--batch_size", str(size), "--max_epoch", "1", "--num_point", "1024"):
        script = importlib.import_module("train")
        held = {split: by_split(run, split) for split in ("train", "test")}
        files = {"train": script.TRAIN_FILES, "test": script.TEST_FILES}
        for split, names in held.items():
            data, label = script.provider.loadDataFile(files[split][0])
            run.same(f"provider.loadDataFile: {split}", data, np.stack([run.truth[f"{n}/points"] for n in names]))
            run.same(
                f"provider.loadDataFile: {split}, classes", label.ravel(), [int(run.truth[f"{n}/class"]) for n in names]
            )
            run.loaded[f"provider.loadDataFile, {split}"] = len(data)
        script.train()
    trained, tested = (len(held[split]) // size for split in ("train", "test"))
    run.holds("train.py: batches of one epoch", len(session.fed) == trained + tested)
    points = np.concatenate([fed[0] for fed in session.fed[:trained]])
    labels = np.concatenate([fed[1] for fed in session.fed[:trained]])
    # It turns about y and moves points by at most 5 cm: heights stay, to that.
    heights = {int(run.truth[f"{n}/class"]): [] for n in held["train"]}
    for name in held["train"]:
        heights[int(run.truth[f"{name}/class"])].append(run.truth[f"{name}/points"][:1024, 1])
    for one, label in zip(points, labels):
        off = min(np.abs(one[:, 1] - height).max() for height in heights[int(label)])
        run.holds("train.py trains on the first 1024 points of each shape, with its class", off <= 0.05 + 1e-6)
    fed = session.fed[trained:]
    wanted = held["test"][: tested * size]
    run.same(
        "train.py tests on",
        np.concatenate([f[0] for f in fed]),
        np.stack([run.truth[f"{n}/points"][:1024] for n in wanted]),
    )
    run.same("train.py tests for", np.concatenate([f[1] for f in fed]), [int(run.truth[f"{n}/class"]) for n in wanted])
    run.loaded["train.py"] = (trained + tested) * size


def pointnet_part(run) -> None:
    """The whole of part_seg/train.py, for one epoch."""
    size = 2
    answers = {}
    session = Session(answers)
    tensorflow(run, session)
    (model,) = run.stub("pointnet_part_seg", always=True)
    classes, parts, shown = MagicMock(), MagicMock(), MagicMock()
    answers.update({id(classes): np.zeros((size, 16)), id(parts): np.zeros(size), id(shown): np.zeros((size, 2048))})
    model.get_model.return_value = (classes, parts, MagicMock())
    model.get_loss.return_value = (*(MagicMock() for _ in range(5)), shown)
    root = laid(run, "provider.py", "part_seg/train.py", data="part_seg/hdf5_data")
    (root / "data/modelnet40_ply_hdf5_2048").mkdir(parents=True, exist_ok=True)  # or provider.py downloads it
    sys.path[:0] = [str(root), str(root / "part_seg")]
    with inside(root / "part_seg", "--batch", str(size), "--epoch", "1"):
        script = importlib.import_module("train")
        script.train()
    held = {split: by_split(run, split) for split in ("train", "val")}
    tested, trained = (len(held[split]) // size for split in ("val", "train"))
    run.holds("part_seg/train.py: batches of one epoch", len(session.fed) == tested + trained)

    def rows(names, key):
        return np.stack([run.truth[f"{name}/{key}"] for name in names])

    points, label, one_hot, seg = (np.concatenate([fed[k] for fed in session.fed[:tested]]) for k in range(4))
    names = held["val"]
    run.same("part_seg/train.py tests on", points, rows(names, "points"))
    run.same("part_seg/train.py tests for classes", label, [int(run.truth[f"{n}/class"]) for n in names])
    run.same("part_seg/train.py tests for parts", seg, rows(names, "labels").reshape(len(names), -1))
    run.holds("part_seg/train.py: one class a shape", bool((one_hot.argmax(1) == label).all()))
    points, label, _, seg = (np.concatenate([fed[k] for fed in session.fed[tested:]]) for k in range(4))
    for one, kind, part in zip(points, label, seg):
        found = [n for n in held["train"] if np.array_equal(run.truth[f"{n}/points"], one)]
        run.holds("part_seg/train.py trains on stored shapes", len(found) == 1)
        if found:
            run.holds("part_seg/train.py: the class of each", int(run.truth[f"{found[0]}/class"]) == kind)
            run.same("part_seg/train.py: the parts of each", part, run.truth[f"{found[0]}/labels"].ravel())
    run.holds("part_seg/train.py: number of parts", len(np.unique(rows(run.names(), "labels"))) <= script.NUM_PART_CATS)
    run.holds("part_seg/train.py: names of classes", [c[0] for c in script.all_obj_cats] == sorted(run.told["classes"]))
    run.loaded["part_seg/train.py"] = (tested + trained) * size


def modelnet(run) -> None:
    """ModelNetDataLoader of the PyTorch port and ModelNetDataset of PointNet++."""
    run.path("pointnet2", "utils") if (run.checkouts / "pointnet2/utils").is_dir() else None
    run.stub("provider")
    run.path("pointnet2")
    run.path("Pointnet_Pointnet2_pytorch", "data_utils")
    from modelnet_dataset import ModelNetDataset
    from ModelNetDataLoader import ModelNetDataLoader

    def wanted(name):
        points = run.truth[f"{name}/points"][:1024]
        points = points - np.mean(points, axis=0)
        return np.concatenate([points / np.sqrt((points**2).sum(1)).max(), run.truth[f"{name}/normals"][:1024]], 1)

    for split in ("train", "test"):
        names = by_split(run, split)
        for uniform in (False, True):
            args = types.SimpleNamespace(num_point=1024, use_uniform_sample=uniform, use_normals=True, num_category=40)
            dataset = ModelNetDataLoader(str(run.export), args, split)
            run.holds("ModelNetDataLoader: number of shapes", len(dataset) == len(names))
            rows = {(int(run.truth[f"{n}/class"]), wanted(n).tobytes()): n for n in names}
            for number in range(len(dataset)):
                points, label = dataset[number]
                if uniform:
                    run.holds("ModelNetDataLoader, farthest points: shape", points.shape == (1024, 6))
                    continue
                close = [
                    n for (kind, _), n in rows.items() if kind == label and np.abs(wanted(n) - points).max() < 1e-6
                ]
                run.holds("ModelNetDataLoader: points, normals and class", len(close) == 1)
            if not uniform:
                run.loaded[f"ModelNetDataLoader, {split}"] = len(dataset)
        dataset = ModelNetDataset(str(run.export), batch_size=2, split=split, normal_channel=True, shuffle=False)
        seen = []
        while dataset.has_next_batch():
            batch, labels = dataset.next_batch(augment=False)
            for points, label in zip(batch, labels):
                close = [
                    n
                    for n in names
                    if int(run.truth[f"{n}/class"]) == label and np.abs(wanted(n) - points).max() < 1e-6
                ]
                run.holds("ModelNetDataset: points, normals and class", len(close) == 1)
                seen += close
        run.holds("ModelNetDataset: every shape once", sorted(seen) == sorted(names))
        run.loaded[f"ModelNetDataset, {split}"] = len(seen)


def pointcept(run) -> None:
    """DefaultDataset as it is, and with the steps that its configurations put behind it."""
    run.path("Pointcept")
    run.bare("pointcept.datasets", run.checkouts / "Pointcept/pointcept/datasets")
    from pointcept.datasets.defaults import DefaultDataset

    keys = {"coord": "points", "color": "colors", "normal": "normals", "segment": "labels"}
    steps = [
        {"type": "CenterShift", "apply_z": True},
        {"type": "GridSample", "grid_size": 0.02, "hash_type": "fnv", "mode": "train", "return_grid_coord": True},
        {"type": "SphereCrop", "point_max": 102400, "mode": "random"},
        {"type": "CenterShift", "apply_z": False},
        {"type": "NormalizeColor"},
        {"type": "ToTensor"},
    ]
    for split in ("train", "val"):
        names = by_split(run, split)
        dataset = DefaultDataset(split, str(run.export))
        run.holds(
            "DefaultDataset: scenes", sorted(dataset.get_data_name(n) for n in range(len(dataset))) == sorted(names)
        )
        features = [key for key in ("color", "normal") if f"{names[0]}/{keys[key]}" in run.truth]
        collect = {"type": "Collect", "keys": ("coord", "grid_coord", "segment"), "feat_keys": tuple(features)}
        made = DefaultDataset(split, str(run.export), transform=[*steps, collect])
        for number in range(len(dataset)):
            got = dataset[number]
            for key, name in keys.items():
                held = run.truth.get(f"{got['name']}/{name}")
                if held is None:
                    run.holds(f"DefaultDataset: no {key}", key not in got or key == "segment")
                    continue
                if key == "color":
                    held = np.round(held * 255)
                run.same(f"DefaultDataset: {key}", got[key], held.reshape(got[key].shape))
            fed = made[number]
            coord = fed["coord"].numpy()
            held = run.truth[f"{made.get_data_name(number)}/points"]
            run.figures["points kept of those of the preset, least"] = min(
                len(coord) / len(held), run.figures.get("points kept of those of the preset, least", 1.0)
            )
            run.holds(
                "with the steps of its configurations: shapes", fed["feat"].shape == (len(coord), 3 * len(features))
            )
            run.holds(
                "with the steps: colors in 0..1",
                "color" not in features or 0 <= fed["feat"][:, :3].min() <= fed["feat"][:, :3].max() <= 1,
            )
            extent = np.abs((coord.max(0) - coord.min(0)) - (held.max(0) - held.min(0))).max()
            run.holds("with the steps: still metres", extent <= 0.04)
        run.loaded[f"DefaultDataset, {split}"] = len(dataset)


SHAPES = {"pointnet": pointnet, "pointnet_part": pointnet_part, "modelnet": modelnet, "pointcept": pointcept}
