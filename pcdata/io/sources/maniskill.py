"""ManiSkill 3's trajectories: ``traj_N/obs/sensor_data/CAMERA/depth`` in one HDF5 file, with a JSON file beside it.

Source: ManiSkill, ``utils/wrappers/record.py`` (T + 1 observations, T actions), ``render/shaders.py`` (depth in whole
millimetres, 0 where nothing was hit; positions with OpenGL's axes), docs, "Observation" (sensor_param). Its intrinsics
count from the corner of the first pixel, as the viewport of a renderer does: width / 2 is the middle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.errors import CaptureError, IntrinsicsError, PoseError
from pcdata.files.opening import read_text
from pcdata.files.sample_names import in_order
from pcdata.files.strict_json import json_object
from pcdata.functional.depth.stored_depth import depth_in_metres
from pcdata.geometry.camera_axes import CAMERA_AXES
from pcdata.geometry.rigid import invert_rigid
from pcdata.io.calibration.foreign_cameras import matrix_of, pinhole_of_matrix
from pcdata.io.sources.demonstration_file import arrays_below, episode_names, opened
from pcdata.io.sources.demonstration_steps import (
    Demonstration,
    Shapes,
    Steps,
    Stream,
    check_lengths,
    color_of,
    plane_of,
    same_cameras,
    seconds_of_rate,
)
from pcdata.io.sources.demonstrations import DemonstrationSource, sample_name
from pcdata.io.sources.frame_files import make_frame
from pcdata.io.sources.listed import one_of, unread_cameras
from pcdata.io.sources.listing import has_file
from pcdata.io.sources.option_checks import check_label, check_name
from pcdata.io.sources.registry import register_layout
from pcdata.io.sources.rendered_images import centered_camera
from pcdata.structures import DepthFrame

_DATA, _PARAM = "obs/sensor_data", "obs/sensor_param"
_DEPTH, _POSITION = "depth", "PositionSegmentation"
_MILLIMETRE = 0.001
_WORLD = "world"
_KNOWN = {"tcp_pose": "pose xyz_quat_wxyz"}  # raw_pose of every task that has it
_PER_STEP = {"rewards": "reward", "success": "success", "fail": "fail", "terminated": "terminated"}
_NO_ACTION = "the last observation of its trajectory: no action follows it"
_MAX_JSON = 1 << 28
_CONTRADICTS = 1e-3  # metres or of a unit axis, between two float32 statements of one pose


@register_layout
class _ManiSkillSource(DemonstrationSource):
    """One observation that an action follows a sample, a view of every camera; joints and extras are signals.

    Labels are the simulator's ids of actors and links, 0 the distant background.
    """

    kind = "maniskill"
    needs = (
        "an .h5 file (or a folder with one) with traj_N/obs/sensor_data/CAMERA/depth and obs/sensor_param/CAMERA "
        "(obs_mode rgb+depth or sensor_data), as RecordEpisode writes it; optional rgb, segmentation, actions, and the "
        ".json beside it"
    )

    def __init__(
        self,
        path: Path,
        *,
        camera: str | None = None,
        signals: Mapping[str, Any] | None = None,
        background_label: int | None = None,
        frame_id: str | None = None,
    ) -> None:
        """Read the names and the number of steps.

        Args:
            path: the file, or a folder with one such file.
            camera: read this one alone; None = all, as views of one sample.
            signals: kinds of observations and actions by name, see :func:`stated_kinds`; None leaves one out. Without
                ``action`` the last observation of every trajectory is read too.
            background_label: the label in the file that means "no object" and becomes -1; None = keep all.
            frame_id: what the frame that the poses lead to is called; None = "world".

        Raises:
            CaptureError: no trajectory has depth, arrays of one have different lengths, or the file is damaged.
            ConfigError: an option is wrong.
        """
        path = self.file_of(path)
        where = f"{self.kind} source {path}"
        self._label = check_label(where, background_label)
        frame = check_name(where, "frame_id", frame_id) or _WORLD
        keeps_last = isinstance(signals, Mapping) and "action" in signals and signals["action"] is None
        facts, seconds = _facts(where, path)
        with opened(where, path) as file:
            names = episode_names(where, file, "traj_")
            if not names:
                raise CaptureError(f"{where}: has no trajectory; this layout needs {self.needs}")
            arrays = arrays_below(f"{where}: {names[0]}", file[names[0]], "obs")
            cameras = _cameras(arrays)
            if not cameras:
                raise CaptureError(
                    f"{where}: {names[0]} has no depth; replay it by python -m "
                    "mani_skill.trajectory.replay_trajectory --obs-mode rgb+depth --save-traj"
                )
            chosen = cameras if camera is None else [one_of(where, "camera", camera, cameras)]
            streams = _streams(where, file[names[0]], arrays, frame)
            if keeps_last:  # what follows an observation is not there for the last one
                streams = {name: stream for name, stream in streams.items() if name not in _PER_STEP.values()}
            demonstrations, skipped = {}, dict[str, str]()
            for name in names:
                length, actions = _lengths(where, file[name], name, cameras)
                if actions == length - 1 and not keeps_last:
                    skipped[sample_name(name, actions)] = _NO_ACTION
                    length = actions
                elif actions not in (None, length, length - 1):
                    raise CaptureError(f"{where}: {name} has {length} observations and {actions} actions")
                if length:
                    demonstrations[name] = Demonstration(name, length, facts.get(name, {}), {}, seconds)
        super().__init__(
            path,
            demonstrations,
            streams,
            cameras=chosen,
            signals=signals,
            frame_id=frame,
            skipped=skipped,
            unread=unread_cameras(cameras, chosen),
        )

    @classmethod
    def _is_such(cls, file: Any) -> bool:
        return bool(episode_names("recognizes", file, "traj_"))

    def _view(self, steps: Steps, camera: str, sample_id: str) -> DepthFrame:
        data, param = f"{_DATA}/{camera}", f"{_PARAM}/{camera}"
        images: dict[str, Tensor] = {}
        if steps.has(f"{data}/{_DEPTH}"):
            stored = plane_of(steps, f"{data}/{_DEPTH}")
            ids = plane_of(steps, f"{data}/segmentation") if steps.has(f"{data}/segmentation") else None
        else:
            stored, ids = _position(steps, f"{data}/{_POSITION}")
        for name in ("rgb", "Color"):
            if steps.has(f"{data}/{name}"):
                images["color"] = torch.from_numpy(color_of(steps, f"{data}/{name}"))
        if ids is not None:
            images["labels"] = torch.from_numpy(ids.astype(np.int64))
        unit = None if stored.dtype.kind == "f" else _MILLIMETRE
        # Beyond 32.767 m the 16 bits of the simulator begin anew, below 0.
        depth = torch.from_numpy(depth_in_metres(f"{steps.where}/{data}", np.maximum(stored, 0), unit))
        if not steps.has(f"{param}/intrinsic_cv"):
            raise IntrinsicsError(f"{steps.where}: has no {param}/intrinsic_cv; record with an obs_mode that has depth")
        matrix = steps.row(f"{param}/intrinsic_cv")
        make = pinhole_of_matrix(f"{steps.where}/{param}/intrinsic_cv", matrix.tolist())
        frame = make_frame(
            {"depth": self.path},
            depth=depth,
            camera=centered_camera(make((depth.shape[0], depth.shape[1]))),
            sample_id=sample_id,
            frame_id=self.frame_id,
            capture_index=0,
            provenance={
                **self.provenance(sample_id),
                "trajectory": steps.demonstration.group,
                "metres_per_unit": _MILLIMETRE if unit else 1.0,
                "unit_is_recorded": True,
            },
            background_label=self._label,
            images=images,
        )
        pose = _pose(steps, param)
        return frame if pose is None else replace(frame, world_from_camera=pose[None], frame_id=self.frame_id)


def _cameras(arrays: Shapes) -> list[str]:
    parts = [path.split("/") for path in arrays if path.startswith(f"{_DATA}/")]
    return in_order({part[2] for part in parts if len(part) == 4 and part[3] in (_DEPTH, _POSITION)})


def _lengths(where: str, group: Any, name: str, cameras: list[str]) -> tuple[int, int | None]:
    """Return how many observations and how many actions a trajectory has."""
    own = f"{where}: {name}"
    arrays = arrays_below(own, group, _DATA)
    same_cameras(where, cameras, _cameras(arrays), name)
    length = check_lengths(
        own, {path: shape for path, shape in arrays.items() if path.endswith((f"/{_DEPTH}", f"/{_POSITION}"))}
    )
    actions = arrays_below(own, group, "actions")
    return length, check_lengths(own, actions) if actions else None


def _streams(where: str, group: Any, arrays: Shapes, world: str) -> dict[str, Stream]:
    """Return the signals: what has one row of numbers a step, under its last name where that is one only."""
    found: dict[str, list[str]] = {}
    for path, shape in arrays.items():
        if path.startswith(("obs/agent/", "obs/extra/")) and len(shape) in (1, 2):
            found.setdefault(path.rpartition("/")[2], []).append(path)
    streams = {
        name if len(paths) == 1 else path.removeprefix("obs/"): Stream(
            (path,), (_KNOWN[name], world) if name in _KNOWN else None
        )
        for name, paths in found.items()
        for path in paths
    }
    for path, shape in arrays_below(where, group, "actions").items():
        if len(shape) in (1, 2):
            streams["action" + path.removeprefix("actions")] = Stream((path,))
    for path, name in _PER_STEP.items():
        if arrays_below(where, group, path).get(path) is not None:
            streams[name] = Stream((path,))
    return streams


def _position(steps: Steps, name: str) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return depth and ids of an image of positions with OpenGL's axes, whose fourth channel are the ids."""
    image = steps.row(name)
    if image.ndim != 3 or image.shape[-1] != 4:
        raise CaptureError(f"{steps.where}/{name}: must be (steps, H, W, 4), got {image.shape} each")
    return -image[..., 2].astype(np.int32), image[..., 3]


def _pose(steps: Steps, param: str) -> Tensor | None:  # (4, 4) float64, world from camera
    """Return where a camera is: its extrinsics the other way, which the other statement of them must agree with.

    Raises:
        PoseError: they contradict each other, or one is not rigid.
    """
    poses = {}
    if steps.has(f"{param}/extrinsic_cv"):
        matrix = steps.row(f"{param}/extrinsic_cv")
        poses["extrinsic_cv"] = invert_rigid(matrix_of(f"{steps.where}/{param}/extrinsic_cv", matrix.ravel().tolist()))
    if steps.has(f"{param}/cam2world_gl"):
        matrix = steps.row(f"{param}/cam2world_gl")
        pose = matrix_of(f"{steps.where}/{param}/cam2world_gl", matrix.ravel().tolist())
        poses["cam2world_gl"] = pose @ CAMERA_AXES["opengl"]
    first = next(iter(poses.values()), None)
    for other in poses.values():
        if first is not None and float((first - other).abs().max()) > _CONTRADICTS:
            raise PoseError(
                f"{steps.where}/{param}: extrinsic_cv and cam2world_gl state poses that differ by "
                f"{float((first - other).abs().max()):.3g}; remove the wrong one"
            )
    return first


def _facts(where: str, path: Path) -> tuple[dict[str, dict[str, Any]], float | None]:
    """Return what the JSON file beside the trajectories tells of each, and the seconds of a step."""
    file = path.with_suffix(".json")
    if not has_file(file):
        return {}, None
    said = json_object(str(file), read_text(where, file, max_bytes=_MAX_JSON, inside=[path.parent]), error=CaptureError)
    about = said.get("env_info")
    env = about if isinstance(about, dict) else {}
    shared = {key: env[key] for key in ("env_id", "max_episode_steps") if isinstance(env.get(key), (str, int))}
    shared |= {key: said[key] for key in ("source_type",) if isinstance(said.get(key), str)}
    episodes = said.get("episodes")
    found = {}
    for one in episodes if isinstance(episodes, list) else []:
        if isinstance(one, dict) and isinstance(one.get("episode_id"), int):
            own = {key: one[key] for key in _OF_EPISODE if isinstance(one.get(key), (str, int, bool))}
            found[f"traj_{one['episode_id']}"] = shared | own
    return found, _seconds(env)


def _seconds(env: Mapping[str, Any]) -> float | None:
    settings = env.get("env_kwargs")
    sim = settings.get("sim_config") if isinstance(settings, dict) else None
    return seconds_of_rate(sim)


_OF_EPISODE: Sequence[str] = ("episode_seed", "control_mode", "success", "fail")
