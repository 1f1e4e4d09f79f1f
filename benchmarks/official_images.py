"""Depth images with the loaders of GraspNet, Contact-GraspNet and GG-CNN; see ``official_open.py``."""

from __future__ import annotations

import contextlib
import importlib
import random
import sys
import types

import numpy as np


@contextlib.contextmanager
def words(*given: str):
    """Let a script see these words on its command line."""
    before = sys.argv[:]
    sys.argv[1:] = given
    try:
        yield
    finally:
        sys.argv[:] = before


def among(points: np.ndarray, held: np.ndarray) -> bool:
    """Whether every row of points is a row of held, to float32."""
    rows = (np.ascontiguousarray(one.astype(np.float32)).view("V12").ravel() for one in (points, held))
    return bool(np.isin(*rows).all())


def graspnet(run) -> None:
    """get_and_process_data of demo.py, from a folder that the export wrote."""
    run.path("graspnet-baseline")
    run.stub("graspnet", "collision_detector", always=True)  # the networks and what follows them
    run.stub("graspnetAPI", "open3d")
    with words("--checkpoint_path", "none"):
        demo = importlib.import_module("demo")
    for name in run.names():
        held = {key: run.truth.get(f"{name}/{key}") for key in ("depth", "mask", "points", "point_colors")}
        valid = held["depth"] > 0
        inside = valid if held["mask"] is None else valid & held["mask"]
        rows = inside[valid]
        end_points, cloud = demo.get_and_process_data(str(run.export / name))
        points, colors = held["points"][rows], held["point_colors"][rows]
        run.holds("demo.py: as many points inside the mask", len(cloud.points) == len(points))
        run.same("demo.py: points", np.asarray(cloud.points), points, 1e-6)
        run.same("demo.py: colors", np.asarray(cloud.colors), colors, 1e-6)
        sampled = end_points["point_clouds"][0].numpy()
        run.holds("demo.py: 20000 of them are drawn", sampled.shape == (20000, 3))
        run.holds("demo.py: what is drawn is inside", among(sampled, np.asarray(cloud.points)))
        run.figures[f"points of {name} inside the mask"] = float(len(cloud.points))
    run.loaded["demo.py get_and_process_data"] = len(run.names())


def graspnet_scene(run) -> None:
    """GraspNetDataset with its crop, with labels, and graspnetAPI."""
    run.path("graspnet-baseline")
    run.path("graspnet-baseline", "dataset")
    from graspnet_dataset import GraspNetDataset

    camera, names, root = run.told["camera"], run.names(), str(run.export)
    plain = GraspNetDataset(root, None, None, camera, "train", remove_outlier=False, load_label=False)
    cropped = GraspNetDataset(root, None, None, camera, "train", remove_outlier=True, load_label=False)
    poses = {}
    for number, name in enumerate(names):
        held, labels = run.truth[f"{name}/points"], run.truth[f"{name}/labels"] + 1
        colors, depth = run.truth[f"{name}/point_colors"], run.truth[f"{name}/depth"]
        points, seen = plain.get_data(number, return_raw_cloud=True)
        run.same("GraspNetDataset: points", points, held, 1e-6)
        run.same("GraspNetDataset: colors", seen, colors, 1e-6)
        run.holds("GraspNetDataset: 20000 are drawn", plain[number]["point_clouds"].shape == (20000, 3))
        # Its crop: the box of what is labeled, along the axes of the table, and 2 cm more.
        pose = run.truth[f"{name}/pose"].astype(np.float64)
        table = held.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        marked = (labels > 0)[depth > 0]
        low, high = table[marked].min(0) - 0.02, table[marked].max(0) + 0.02
        inside = ((table > low) & (table < high)).all(1)
        got, _ = cropped.get_data(number, return_raw_cloud=True)
        run.figures[f"{name}: points of the crop, loader and pcdata differ by"] = float(abs(len(got) - inside.sum()))
        run.holds("remove_outlier: the box around the objects in the table's frame", abs(len(got) - inside.sum()) <= 5)
        poses[name] = pose
    run.loaded["GraspNetDataset"] = len(names)
    from graspnetAPI import GraspNet

    api = GraspNet(root, camera=camera, split="train")
    run.holds("graspnetAPI: object ids are read", isinstance(api.getObjIds(list(range(100))), list))
    for number, name in enumerate(names):
        points, colors = api.loadScenePointCloud(0, camera, number, align=False, format="numpy")
        run.same("graspnetAPI loadScenePointCloud: points", points, run.truth[f"{name}/points"], 1e-6)
        run.same("graspnetAPI loadScenePointCloud: colors", colors, run.truth[f"{name}/point_colors"], 1e-6)
        pose = poses[name]
        held = run.truth[f"{name}/points"].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        points, _ = api.loadScenePointCloud(0, camera, number, align=True, format="numpy")
        run.same("graspnetAPI loadScenePointCloud: aligned to the table", points, held, 1e-6)
        mask = api.loadMask(0, camera, number)
        wanted = run.truth[f"{name}/labels"] + 1
        run.same("graspnetAPI loadMask: labels", mask, wanted)
        run.same(
            "graspnetAPI loadDepth: millimetres",
            api.loadDepth(0, camera, number),
            np.round(run.truth[f"{name}/depth"] * 1000),
        )
    run.loaded["graspnetAPI GraspNet"] = len(names)


def contact_graspnet(run) -> None:
    """load_available_input_data, and what the estimator makes of it before the network."""
    run.path("contact_graspnet", "contact_graspnet")
    run.stub("tensorflow", "tensorflow.compat", "tensorflow.compat.v1", "trimesh", "trimesh.transformations")
    run.stub("provider", "scene_renderer", "tf_train_ops", "config_utils", always=True)  # training and the network
    import data
    from contact_grasp_estimator import GraspEstimator

    for name in run.names():
        held = {key: run.truth[f"{name}/{key}"] for key in ("depth", "colors", "labels", "intrinsics", "points")}
        segmap, rgb, depth, matrix, full, _ = data.load_available_input_data(str(run.export / f"{name}.npz"))
        run.same("load_available_input_data: depth", depth, held["depth"])
        run.same("load_available_input_data: K", matrix, held["intrinsics"].astype(np.float64))
        run.same("load_available_input_data: segmap", segmap, held["labels"] + 1)
        run.same("load_available_input_data: rgb", rgb, held["colors"])
        run.holds("load_available_input_data: no cloud beside the depth", full is None)
        config = {"DATA": {"raw_num_points": 20000, "use_farthest_point": False}}
        estimator = types.SimpleNamespace(_contact_grasp_cfg=config)
        cloud, segments, _ = GraspEstimator.extract_point_clouds(estimator, depth, matrix, segmap=segmap, rgb=rgb)
        near = (held["points"][:, 2] > 0.2) & (held["points"][:, 2] < 1.8)
        run.same("extract_point_clouds: points", cloud, held["points"][near], 1e-6)
        ids = sorted(set((held["labels"] + 1).ravel().tolist()) - {0})
        run.holds("extract_point_clouds: segments", sorted(segments) == ids)
        for one in segments:
            rows = (held["labels"] + 1 == one)[held["depth"] > 0] & near
            run.same("extract_point_clouds: points of a segment", segments[one], held["points"][rows], 1e-6)
        regions, _ = GraspEstimator.extract_3d_cam_boxes(estimator, cloud, dict(segments))
        for region in regions.values():
            made, mean = data.preprocess_pc_for_inference(
                region.squeeze(), 20000, return_mean=True, convert_to_internal_coords=True
            )
            run.holds("extract_3d_cam_boxes: 20000 points around every object", made.shape == (20000, 3))
            back = (made + mean) * np.array([-1, -1, 1])
            run.same("preprocess_pc_for_inference: x and y turned, mean taken off", back, region, 1e-6)
    run.loaded["load_available_input_data"] = len(run.names())


def ggcnn(run) -> None:
    """CornellDataset: images, grasps, crops; then turned and zoomed at random."""
    run.path("ggcnn")
    from utils.data.cornell_data import CornellDataset
    from utils.dataset_processing.grasp import GraspRectangles
    from utils.dataset_processing.image import DepthImage, Image

    dataset = CornellDataset(str(run.export), include_depth=True, include_rgb=True)
    names = run.names()
    run.holds("CornellDataset: number of images", len(dataset) == len(names))
    for number, name in enumerate(names):
        depth, colors = run.truth[f"{name}/depth"], run.truth[f"{name}/colors"]
        grasps = run.truth[f"{name}/grasps"]
        whole = DepthImage.from_tiff(dataset.depth_files[number]).img
        run.same("DepthImage.from_tiff: metres where there is a reading", whole[depth > 0], depth[depth > 0])
        run.holds("DepthImage.from_tiff: nothing is left open", np.isfinite(whole).all() and (whole > 0).all())
        run.same("Image.from_file: colors", np.asarray(Image.from_file(dataset.rgb_files[number]).img), colors)
        read = GraspRectangles.load_from_cornell_file(dataset.grasp_files[number])
        run.same("load_from_cornell_file: corners, y before x", np.stack([g.points for g in read]), grasps[..., ::-1])
        x, (quality, cos, sin, width), *_ = dataset[number]
        center = grasps.reshape(-1, 2).mean(0)[::-1].astype(int)
        top, left = (max(0, min(c - 150, most - 300)) for c, most in zip(center, (480, 640)))
        part = whole[top : top + 300, left : left + 300]
        run.same(
            "CornellDataset: the window around the grasps, less its mean",
            x[0].numpy(),
            np.clip(part - part.mean(), -1, 1),
            1e-6,
        )
        seen = colors[top : top + 300, left : left + 300].astype(np.float32) / 255
        run.same("CornellDataset: colors", x[1:].numpy(), (seen - seen.mean()).transpose(2, 0, 1), 1e-5)
        run.holds("CornellDataset: grasps are drawn", quality.sum() > 0 and width.max() > 0)
        run.holds("CornellDataset: angles are unit vectors", bool(((cos**2 + sin**2) - 1).abs().max() < 1e-5))
    random.seed(0)
    turned = CornellDataset(str(run.export), include_depth=True, include_rgb=True, random_rotate=True, random_zoom=True)
    for number in [n for n in range(len(turned)) for _ in range(4)]:
        run.holds("turned and zoomed: finite", bool(np.isfinite(turned[number][0].numpy()).all()))
    run.loaded["CornellDataset"] = len(dataset)


IMAGES = {"graspnet": graspnet, "graspnet_scene": graspnet_scene, "contact_graspnet": contact_graspnet, "ggcnn": ggcnn}
