"""Tiny files of simulators, as their own programs write them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from tests.published_captures import SIZE, color, depth_mm, turned

HEIGHT, WIDTH = SIZE
NEAR, FAR = 0.02, 20.0
K = [[10.0, 0.0, WIDTH / 2], [0.0, 10.0, HEIGHT / 2], [0.0, 0.0, 1.0]]  # from the corner of the first pixel
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def metres(seed: int) -> np.ndarray:
    return (depth_mm(seed) / 1000).astype(np.float32)


def camera_pose(number: int) -> np.ndarray:
    return turned(number)


def robomimic(root: Path, *, raw: bool = False, length: int = 3, **changes: Any) -> Path:
    """Two demonstrations of two cameras, one of them on the hand; ``raw``: as robosuite observes."""
    import h5py

    root.mkdir(parents=True, exist_ok=True)
    path = root / "demo.hdf5"
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = 2 * length
        data.attrs["env_args"] = json.dumps(
            {"env_name": "Lift", "env_version": "1.4.1", "type": 1, "env_kwargs": {"control_freq": 20}}
        )
        for number in (0, 10):
            demo = data.create_group(f"demo_{number}")
            demo.attrs["num_samples"] = length
            for name, width in (("actions", 7), ("states", 5)):
                demo[name] = np.arange(length * width, dtype=np.float64).reshape(length, width) / 8
            demo["rewards"], demo["dones"] = np.arange(length) / 2, np.arange(length) == length - 1
            obs = demo.create_group("obs")
            for camera in ("agentview", "robot0_eye_in_hand"):
                depth = np.stack([metres(number + step) for step in range(length)])
                image = np.stack([color(number + step) for step in range(length)])
                if raw:
                    depth = ((1 - NEAR / depth.astype(np.float64)) / (1 - NEAR / FAR)).astype(np.float32)
                    depth[:, 0, 0] = 1.0
                    depth, image = depth[:, ::-1], image[:, ::-1]
                obs.create_dataset(f"{camera}_depth", data=depth[..., None], compression="gzip")
                obs.create_dataset(f"{camera}_image", data=image, compression="gzip")
            obs["agentview_segmentation_instance"] = np.full((length, *SIZE, 1), 4, np.int32)
            obs["robot0_eef_pos"] = np.tile([0.1, 0.2, 0.3], (length, 1))
            obs["robot0_eef_quat"] = np.tile([0.0, 0.0, 1.0, 0.0], (length, 1))
            obs["robot0_joint_pos"] = np.tile(np.arange(7.0), (length, 1))
            if not raw:
                info = {name: {"intrinsics": K, "extrinsics": camera_pose(1).tolist()} for name in _CAMERAS}
                demo.attrs["camera_info"] = json.dumps(info)
            else:
                demo.attrs["model_file"] = changes.get("model", MODEL)
            demo.attrs["ep_meta"] = json.dumps({"lang": "lift the cube"})
            for name, value in changes.items():
                if name != "model":
                    demo.attrs[name] = value
    return path


_CAMERAS = ("agentview", "robot0_eye_in_hand")
_FOVY = float(np.degrees(2 * np.arctan(HEIGHT / 2 / 10)))
MODEL = f"""<mujoco model="base"><statistic extent="2"/><visual><map znear="0.01" zfar="10"/></visual>
<worldbody><!-- a table --><camera name="agentview" mode="fixed" pos="0.5 0 1.35" quat="0.653 0.271 0.271 0.653"
fovy="{_FOVY!r}"/><body name="hand"><camera name="robot0_eye_in_hand" pos="0 0 0" fovy="{_FOVY!r}"/></body></worldbody>
</mujoco>"""


def maniskill(root: Path, *, length: int = 3, positions: bool = False, **changes: Any) -> Path:
    """Two trajectories of two cameras, one action fewer than observations."""
    import h5py

    root.mkdir(parents=True, exist_ok=True)
    path = root / "trajectory.h5"
    episodes = []
    with h5py.File(path, "w") as file:
        for number in (0, 1):
            trajectory = file.create_group(f"traj_{number}", track_order=True)
            episodes.append({"episode_id": number, "control_mode": "pd_ee_delta_pose", "success": number == 0})
            for camera in ("base_camera", "hand_camera"):
                depth = np.stack([depth_mm(number + step).astype(np.int16) for step in range(length)])
                depth[:, 0, 0], depth[:, 0, 1] = 0, -300  # nothing hit; farther than 16 bits reach
                ids = np.full((length, *SIZE), 16, np.int16)
                picture = np.stack([color(number + step) for step in range(length)])
                data = trajectory.create_group(f"obs/sensor_data/{camera}")
                if positions:
                    place = np.zeros((length, *SIZE, 4), np.int16)
                    place[..., 2], place[..., 3] = -depth, ids
                    data["PositionSegmentation"] = place
                    data["Color"] = np.concatenate([picture, np.full((length, *SIZE, 1), 255, np.uint8)], -1)
                else:
                    data.create_dataset("depth", data=depth[..., None], compression="gzip", compression_opts=5)
                    data.create_dataset("segmentation", data=ids[..., None])
                    data.create_dataset("rgb", data=picture, compression="gzip", compression_opts=5)
                poses = np.stack([camera_pose(number + step) for step in range(length)])
                param = trajectory.create_group(f"obs/sensor_param/{camera}")
                param["intrinsic_cv"] = np.tile(np.array(K, np.float32), (length, 1, 1))
                param["extrinsic_cv"] = np.linalg.inv(poses)[:, :3].astype(np.float32)
                param["cam2world_gl"] = (poses @ changes.get("axes", OPENGL)).astype(np.float32)
            trajectory["obs/agent/qpos"] = np.tile(np.arange(9, dtype=np.float32), (length, 1))
            trajectory["obs/agent/qvel"] = np.zeros((length, 9), np.float32)
            trajectory["obs/extra/tcp_pose"] = np.tile(np.float32([0.1, 0.2, 0.3, 0, 1, 0, 0]), (length, 1))
            trajectory["obs/extra/is_grasped"] = np.arange(length) > 1
            actions = changes.get("actions", length - 1)
            trajectory["actions"] = np.arange(actions * 7, dtype=np.float32).reshape(actions, 7)
            trajectory["rewards"] = np.arange(length - 1, dtype=np.float32)
            for name in ("terminated", "truncated", "success"):
                trajectory[name] = np.zeros(length - 1, bool)
            trajectory["env_states/actors/cube"] = np.zeros((length, 13), np.float32)
    about = {"env_id": "PickCube-v1", "env_kwargs": {"sim_config": {"control_freq": 20}}, "max_episode_steps": 50}
    said = {"env_info": about, "commit_info": None, "episodes": episodes, "source_type": "motionplanning"}
    path.with_suffix(".json").write_text(json.dumps(said, indent=2))
    return path


CAPTURES = {"robomimic": robomimic, "maniskill": maniskill}
