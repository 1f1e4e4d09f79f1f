"""Replay buffers, DemoGen and RISE with the loaders of the policies; see ``official_open.py``."""

from __future__ import annotations

import importlib
import shutil
import types

import numpy as np


def windows(ends: np.ndarray, horizon: int, before: int, after: int) -> list[np.ndarray]:
    """Steps of every sequence, in order: diffusion policy's rule, written anew."""
    found = []
    for first, end in zip((0, *ends[:-1]), ends):
        for start in range(-before, end - first - horizon + after + 1):
            found.append(first + np.clip(np.arange(start, start + horizon), 0, end - first - 1))
    return found


def sequences(run, name: str, dataset, horizon: int, before: int, after: int, extra=()) -> None:
    """Every sequence of a data set equals the steps that pcdata holds."""
    truth = run.truth
    wanted = windows(truth["ends"], horizon, before, after)
    run.holds(f"{name}: number of sequences", len(dataset) == len(wanted))
    run.same(f"{name}: episode ends", dataset.replay_buffer.episode_ends[:], truth["ends"])
    for number, steps in enumerate(wanted):
        got = dataset[number]
        run.same(f"{name}: point_cloud", got["obs"]["point_cloud"].numpy(), truth["point_cloud"][steps])
        run.same(f"{name}: agent_pos", got["obs"]["agent_pos"].numpy(), truth["state"][steps])
        run.same(f"{name}: action", got["action"].numpy(), truth["action"][steps])
        for key in extra:
            run.same(f"{name}: {key}", got["obs"][key].numpy(), truth[key][steps])
        if "windows_action" in truth and (horizon, before, after) == (16, 1, 7):
            run.same(f"{name}: action of EpisodeWindows", got["action"].numpy(), truth["windows_action"][number])
    run.loaded[name] = len(dataset)
    half = type(dataset)(str(run.export), horizon=horizon, pad_before=before, pad_after=after, val_ratio=0.34)
    parts = len(half) + len(half.get_validation_dataset())
    run.holds(f"{name}: training and validation together are all", parts == len(dataset))


def normalized(run, name: str, dataset, identity=()) -> None:
    """The data set's normalizer takes the data to -1..1 and back."""
    import torch

    normalizer = dataset.get_normalizer()
    data = {"action": run.truth["action"], "agent_pos": run.truth["state"], "point_cloud": run.truth["point_cloud"]}
    for key, values in data.items():
        values = torch.from_numpy(values.astype(np.float32))
        scaled = normalizer[key].normalize(values)
        if key in identity:
            run.same(f"{name}: {key} is not scaled", scaled.detach().numpy(), values.numpy())
            continue
        run.holds(f"{name}: {key} is scaled to -1..1", float(scaled.abs().max()) <= 1 + 1e-5)
        back = normalizer[key].unnormalize(scaled).detach().numpy()
        largest = float(values.abs().max())
        run.holds(f"{name}: {key} comes back", float(np.abs(back - values.numpy()).max()) <= 1e-6 * max(largest, 1.0))


def dp3(run) -> None:
    """AdroitDataset, the buffer from disk, and its copy into a store."""
    run.path("3D-Diffusion-Policy", "3D-Diffusion-Policy")
    from diffusion_policy_3d.common.replay_buffer import ReplayBuffer
    from diffusion_policy_3d.dataset.adroit_dataset import AdroitDataset

    for horizon, before, after in ((16, 1, 7), (4, 1, 3), (1, 0, 0)):
        name = "AdroitDataset" if horizon == 16 else f"AdroitDataset, horizon {horizon}"
        sequences(run, name, AdroitDataset(str(run.export), horizon, before, after), horizon, before, after)
    normalized(run, "AdroitDataset", AdroitDataset(str(run.export), 16, 1, 7))
    disk = ReplayBuffer.create_from_path(str(run.export))
    for key in ("point_cloud", "state", "action"):
        run.same(f"ReplayBuffer.create_from_path: {key}", disk[key][:], run.truth[key])
    for number in range(disk.n_episodes):
        first = 0 if number == 0 else int(run.truth["ends"][number - 1])
        last = int(run.truth["ends"][number])
        run.same("ReplayBuffer.get_episode", disk.get_episode(number)["action"], run.truth["action"][first:last])
    import zarr

    try:
        ReplayBuffer.copy_from_path(str(run.export), store=zarr.MemoryStore())
        run.also["copy into a store"] = "runs"
    except AttributeError as error:
        run.also["copy into a store"] = f"fails in its own last lines: {error}"


def dexart(run) -> None:
    """DexArtDataset of DP3."""
    run.path("3D-Diffusion-Policy", "3D-Diffusion-Policy")
    from diffusion_policy_3d.dataset.dexart_dataset import DexArtDataset

    dataset = DexArtDataset(str(run.export), 16, 1, 7)
    sequences(run, "DexArtDataset", dataset, 16, 1, 7, extra=("imagin_robot",))
    normalized(run, "DexArtDataset", dataset, identity=("point_cloud",))


def idp3(run) -> None:
    """GR1DexDataset3D, which draws among the stored points."""
    run.path("Improved-3D-Diffusion-Policy", "Improved-3D-Diffusion-Policy")
    from diffusion_policy_3d.dataset.gr1_dex_dataset_3d import GR1DexDataset3D

    truth = run.truth
    for count in (4096, 10000, 12000):
        name = f"GR1DexDataset3D, num_points {count}"
        dataset = GR1DexDataset3D(str(run.export), horizon=16, pad_before=1, pad_after=14, num_points=count)
        wanted = windows(truth["ends"], 16, 1, 14)
        run.holds(f"{name}: number of sequences", len(dataset) == len(wanted))
        for number in range(0, len(wanted), 1 if count == 4096 else 8):
            got, steps = dataset[number], wanted[number]
            run.same(f"{name}: agent_pos", got["obs"]["agent_pos"].numpy(), truth["state"][steps])
            run.same(f"{name}: action", got["action"].numpy(), truth["action"][steps])
            points = got["obs"]["point_cloud"].numpy()
            run.holds(f"{name}: shape", points.shape == (16, count, 6))
            for have, held in zip(points[::5].astype(np.float32), truth["point_cloud"][steps[::5]]):
                have, held = (np.ascontiguousarray(one).view("V24").ravel() for one in (have, held))
                if count == 10000:
                    run.holds(
                        f"{name}: the same points, in another order", np.array_equal(np.sort(have), np.sort(held))
                    )
                else:
                    zeros = np.zeros(1, "V24")
                    run.holds(
                        f"{name}: points are stored ones or zeros", np.isin(have, np.concatenate([held, zeros])).all()
                    )
        run.loaded[name] = len(dataset)
    normalized(run, "GR1DexDataset3D", dataset, identity=("point_cloud", "agent_pos"))


def maniflow(run) -> None:
    """RoboTwinDataset, without and with its change of colors."""
    run.path("ManiFlow_Policy", "ManiFlow")
    run.stub("pytorch3d", "pytorch3d.ops")
    from maniflow.dataset.robotwin_dataset import RoboTwinDataset

    dataset = RoboTwinDataset(str(run.export), horizon=16, pad_before=1, pad_after=7)
    sequences(run, "RoboTwinDataset", dataset, 16, 1, 7)
    normalized(run, "RoboTwinDataset", dataset)
    changed = {"aug_color": True, "params": [0.4, 0.4, 0.2, 0.1], "prob": 1.0}
    colored = RoboTwinDataset(
        str(run.export), horizon=16, pad_before=1, pad_after=7, use_pc_color=True, pointcloud_color_aug_cfg=changed
    )
    for number in range(0, len(colored), 9):
        points, plain = (one[number]["obs"]["point_cloud"].numpy() for one in (colored, dataset))
        run.same("RoboTwinDataset with color jitter: xyz stay", points[..., :3], plain[..., :3])
        inside = points[..., 3:].min() >= 0 and points[..., 3:].max() <= 1
        run.holds("RoboTwinDataset with color jitter: colors in 0..1", inside)
        run.holds("RoboTwinDataset with color jitter: colors not all clamped", 0.02 < points[..., 3:].mean() < 0.98)


def demogen(run) -> None:
    """The generator, with the masks that its own camera would give; what it makes is opened again."""
    run.path("3D-Diffusion-Policy", "3D-Diffusion-Policy")
    run.path("DemoGen", "demo_generation")
    if (run.checkouts / "DemoGen/diffusion_policies").is_dir():
        run.path("DemoGen", "diffusion_policies")
    try:
        importlib.import_module("diffusion_policies.common.replay_buffer")
    except ImportError:
        run.stub("diffusion_policies", "diffusion_policies.common", always=True)
        import sys

        sys.modules["diffusion_policies.common.replay_buffer"] = importlib.import_module(
            "diffusion_policy_3d.common.replay_buffer"
        )
        run.also["diffusion_policies.common.replay_buffer"] = "3D-Diffusion-Policy's file of that name"
    import zarr
    from demo_generation.demogen import DemoGen
    from demo_generation.mask_util import image_size, intrinsic_matrix, project_points_to_image, restore_original_pcd
    from diffusion_policy_3d.common.replay_buffer import ReplayBuffer
    from imageio import imwrite

    truth, root = run.truth, run.scratch
    shutil.rmtree(root / "datasets", ignore_errors=True)
    for copy in ("set", "led"):
        shutil.copytree(run.export, root / f"datasets/source/{copy}.zarr")
    starts = (0, *truth["ends"][:-1])
    for episode, first in enumerate(starts):
        cube = truth["point_cloud"][first][truth["labels"][first] == 1]
        pixels = project_points_to_image(restore_original_pcd(cube), intrinsic_matrix)
        mask = np.zeros(image_size[::-1], np.uint8)
        for x, y in pixels.astype(int):
            mask[y - 4 : y + 5, x - 4 : x + 5] = 255
        for copy in ("set", "led"):
            folder = root / f"sam_mask/{copy}/{episode}"
            folder.mkdir(parents=True, exist_ok=True)
            imwrite(str(folder / "cube.jpg"), mask)
    lengths = np.diff((0, *truth["ends"]))
    frame = int(lengths.min()) // 3
    far = np.array([0.1, -0.05, 0.0])

    def generate(name: str, source: str, shift: np.ndarray):
        config = types.SimpleNamespace(
            data_root=str(root), source_name=source, task_n_object=1, use_linear_interpolation=True,
            interpolate_step_size=0.01, use_manual_parsing_frames=True, parsing_frames={"skill-1": frame},
            mask_names={"object": "cube", "target": "cube"},
            trans_range={name: {"object": [shift, shift], "target": [shift, shift]}},
            generation=types.SimpleNamespace(range_name=name, n_gen_per_source=1, render_video=False, mode="random"),
        )  # fmt: skip
        made = DemoGen(config)
        made.generate_demo()
        return made, ReplayBuffer.copy_from_path(str(root / f"datasets/generated/{source}_{name}_1.zarr"))

    def beside(moved) -> float:
        """How far the hand of the generated episodes ends from where the object was moved, at most."""
        last = truth["ends"] - 1
        return float(np.abs(moved["state"][last, :3] - truth["state"][last, :3] - far)[:, :2].max())

    made, moved = generate("moved", "set", far)
    for key in ("point_cloud", "state", "action"):
        run.same(f"DemoGen reads {key}", made.replay_buffer[key][:], truth[key])
    run.same("DemoGen reads episode ends", made.replay_buffer.episode_ends[:], truth["ends"])
    run.same("generated: episode ends", moved.episode_ends[:], truth["ends"])
    run.same("generated: numbers beside x y z of actions stay", moved["action"][:, 3:], truth["action"][:, 3:])
    shares = []
    for first in starts:
        source, new = truth["point_cloud"][first][truth["labels"][first] == 1], moved["point_cloud"][first]
        distance = np.abs(new[None, :, :3] - (source[:, None, :3] + far)).max(-1).min(1)
        shares.append(float((distance < 1e-5).mean()))
    run.holds("generated: the object is moved, all of its points", min(shares) == 1)
    # The generator takes the action of a step for the motion that led to it, not for the one that follows.
    run.figures["hand beside the moved object, actions that follow the step, m"] = beside(moved)
    led = np.zeros_like(truth["action"])
    led[1:] = truth["action"][:-1]
    led[list(starts)] = 0
    zarr.open(str(root / "datasets/source/led.zarr"), "a")["data/action"][:] = led
    _, moved = generate("moved", "led", far)
    run.figures["hand beside the moved object, actions that led to the step, m"] = beside(moved)
    run.holds("generated: the hand ends at the moved object, with actions that led to the step", beside(moved) < 1e-5)
    run.loaded["DemoGen"] = len(lengths)


def rise(run) -> None:
    """RealWorldDataset: clouds before and after its voxels, and poses in the camera's frame."""
    run.path("pytorch3d")
    run.path("RISE")
    run.stub("MinkowskiEngine")
    from dataset import constants
    from dataset.realworld import RealWorldDataset
    from scipy.spatial import cKDTree

    truth, names = run.truth, run.names()
    serial = "750612070851"
    intrinsics = truth[f"{names[0]}/intrinsics"]
    # What the export's note asks for: the loader has intrinsics in dataset/constants.py alone.
    constants.INTRINSICS[serial] = np.concatenate([intrinsics, np.zeros((3, 1))], 1)
    firsts = np.cumsum((0, *truth["lengths"][:-1]))
    places = [(n, k) for n, length in enumerate(truth["lengths"]) for k in range(length - 1)]
    for num_obs, num_action in ((1, 20), (2, 5)):
        name = f"RealWorldDataset, num_obs {num_obs}, num_action {num_action}"
        dataset = RealWorldDataset(str(run.export), "train", num_obs=num_obs, num_action=num_action, with_cloud=True)
        run.holds(f"{name}: number of samples", len(dataset) == len(places))
        for number, (episode, step) in enumerate(places):
            got, last = dataset[number], truth["lengths"][episode] - 1
            acts = [names[firsts[episode] + min(step + 1 + k, last)] for k in range(num_action)]
            poses = np.stack([truth[f"{one}/tcp"] for one in acts])
            rows = np.concatenate([poses[:, :3, 3], poses[:, 0, :3], poses[:, 1, :3]], 1)
            run.same(f"{name}: poses in the camera's frame", got["action"][:, :9].numpy(), rows, 1e-5)
            widths = np.stack([truth[f"{one}/width"] for one in acts])
            run.same(f"{name}: widths", got["action"][:, 9:].numpy(), widths, 1e-7)
            for k in range(num_obs):
                shown = names[firsts[episode] + max(step - num_obs + 1 + k, 0)]
                voxels, cloud = truth[f"{shown}/voxels"], got["clouds_list"][k]
                run.holds(f"{name}: as many voxels as the preset", len(cloud) == len(voxels))
                off = cKDTree(voxels).query(cloud[:, :3])[0]
                run.figures["voxel means: farthest from the preset's, m"] = max(
                    float(off.max()), run.figures.get("voxel means: farthest from the preset's, m", 0.0)
                )
                share = float((off < 1e-5).mean())  # the rest: a point on the border of two voxels is in the other
                run.figures["voxel means: share that are the preset's to 0.01 mm"] = min(
                    share, run.figures.get("voxel means: share that are the preset's to 0.01 mm", 1.0)
                )
                run.holds("voxel means are the preset's, 99% of them to 0.01 mm", share > 0.99)
        run.loaded[name] = len(dataset)
    fine = RealWorldDataset(str(run.export), "train", num_obs=1, voxel_size=1e-7, with_cloud=True)
    for number in range(0, len(places), 5):
        episode, step = places[number]
        shown = names[firsts[episode] + step]
        held, colors = truth[f"{shown}/points"], truth[f"{shown}/point_colors"]
        inside = (np.abs(held[:, :2]).max(1) <= 0.5) & (held[:, 2] <= 1.0)
        rows = np.concatenate([held, colors], 1)[inside].astype(np.float64)
        got = fine[number]["clouds_list"][0].copy()
        got[:, 3:] = got[:, 3:] * np.array([0.229, 0.224, 0.225]) + np.array([0.485, 0.456, 0.406])
        run.holds("every pixel: as many points", len(got) == len(rows))
        off, place = cKDTree(rows[:, :3]).query(got[:, :3])
        run.holds("every pixel: each once", len(np.unique(place)) == len(rows))
        run.same("every pixel: points", got[:, :3], rows[place, :3], 1e-6)
        run.same("every pixel: colors", got[:, 3:], rows[place, 3:], 1e-6)
    moved = RealWorldDataset(str(run.export), "train", aug=True)[3]
    run.holds("with its augmentation: finite", bool(np.isfinite(moved["action"].numpy()).all()))


POLICIES = {"dp3": dp3, "dexart": dexart, "idp3": idp3, "maniflow": maniflow, "demogen": demogen, "rise": rise}
