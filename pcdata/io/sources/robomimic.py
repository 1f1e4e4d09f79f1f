"""robosuite's demonstrations as robomimic stores them: ``data/demo_N/obs/CAMERA_depth`` in one HDF5 file.

robomimic's own extraction writes ``camera_info`` beside depth in metres with the top row first. Observations that were
stored as robosuite gives them are a renderer's buffer, with the bottom row first: nothing in the file says which, so it
is asked for.

Source: robomimic, ``scripts/dataset_states_to_obs.py`` (camera_info, obs) and ``envs/env_robosuite.py`` (rows, metres);
robosuite, ``utils/camera_utils.py`` (intrinsics, extrinsics, ``get_real_depth_map``) and ``macros.py``
(IMAGE_CONVENTION). Its principal point, width / 2, counts from the corner of the first pixel: rays into a model agree
with depth that MuJoCo rendered of it to 0.1 um with (width - 1) / 2.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.errors import CaptureError, ConfigError, IntrinsicsError, near_matches
from pcdata.files.sample_names import in_order, name_some
from pcdata.functional.depth.rendered import check_planes, z_of_rendered
from pcdata.functional.depth.stored_depth import depth_in_metres
from pcdata.io.arrays.hdf5_arrays import hard_linked
from pcdata.io.sources.demonstration_file import arrays_below, episode_names, json_attribute, opened, text_attribute
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
    without_frame,
)
from pcdata.io.sources.demonstrations import DemonstrationSource
from pcdata.io.sources.frame_files import make_frame
from pcdata.io.sources.listed import one_of, unread_cameras
from pcdata.io.sources.option_checks import check_label, check_name, check_numbers, check_pinhole
from pcdata.io.sources.registry import register_layout
from pcdata.io.sources.rendered_images import ROWS
from pcdata.io.sources.robosuite_cameras import KnownCameras, StatedCameras, known_cameras
from pcdata.io.sources.stated import opened_calibration
from pcdata.structures import Calibration, DepthFrame

_DEPTH, _COLOR, _LABELS = "_depth", "_image", "_segmentation_"
_WORLD = "world"
_OTHERS = {"actions": "action", "actions_abs": "actions_abs", "rewards": "reward", "dones": "done", "states": "states"}
_DEPTH_IS = ("z", "z_buffer")
_AT_FAR = 1 - 1e-6  # of the far plane, in float32


@register_layout
class _RobomimicSource(DemonstrationSource):
    """One step of a demonstration a sample, a view of every camera whose pose is known; observations are signals.

    ``NAME_eef_pos`` and ``NAME_eef_quat`` are the signal ``NAME_eef_pose``; other observations are numbers that nothing
    moves, where ``signals`` does not say more. Labels are robosuite's ids, of the one kind of segmentation there is.
    """

    kind = "robomimic"
    needs = (
        "an .hdf5 file (or a folder with one) with data/demo_N/obs/CAMERA_depth; optional CAMERA_image, "
        "CAMERA_segmentation_LEVEL, other obs, actions, rewards; camera_info or model_file of each demonstration, or "
        "the options"
    )

    def __init__(
        self,
        path: Path,
        *,
        camera: str | None = None,
        intrinsics: tuple[float, float, float, float] | None = None,
        calibration: Calibration | str | os.PathLike[str] | None = None,
        depth_values: str | None = None,
        near: float | None = None,
        far: float | None = None,
        rows: str | None = None,
        signals: Mapping[str, Any] | None = None,
        labels_from: str | None = None,
        background_label: int | None = None,
        frame_id: str | None = None,
    ) -> None:
        """Read the names, the number of steps and what is said of the cameras.

        Args:
            path: the file, or a folder with one such file.
            camera: read this one alone; None = all whose poses are known, as views of one sample.
            intrinsics: (fx, fy, cx, cy) in pixels of ``camera``, where the file does not say them.
            calibration: a :class:`Calibration` or its file: its cameras go before what the file says of them, and so
                do its poses where it has transforms to ``frame_id``.
            depth_values: "z" for metres, "z_buffer" for robosuite's observations as they are; None = as the file says.
            near: metres, of a buffer: znear times the model's extent; None = as the file says.
            far: metres, of a buffer: zfar times the model's extent; None = as the file says.
            rows: "top_first" or "bottom_first"; None = as the file says.
            signals: kinds of observations and actions by name, see :func:`stated_kinds`; None leaves one out.
            labels_from: which segmentation becomes labels: "instance", "class", "element"; None = the only one.
            background_label: the label in the file that means "no object" and becomes -1; None = keep all.
            frame_id: where the poses lead to; None = "world".

        Raises:
            CaptureError: no demonstration has depth, arrays of one have different lengths, or the file is damaged.
            IntrinsicsError: nothing says the intrinsics of a camera.
            ConfigError: nothing says whether depth is metres or a buffer or which row is first, or an option is wrong.
        """
        path = self.file_of(path)
        where = f"{self.kind} source {path}"
        self._label = check_label(where, background_label)
        self.near, self.far = near, far
        check_numbers(where, self, whole=(), real=[name for name in ("near", "far") if getattr(self, name) is not None])
        self._stated = StatedCameras(
            None if intrinsics is None else check_pinhole(where, intrinsics),
            None if calibration is None else opened_calibration(calibration)[0],
            check_name(where, "frame_id", frame_id) or _WORLD,
            near,
            far,
        )
        self._last: tuple[str, KnownCameras] | None = None  # of the demonstration that was read last
        with opened(where, path) as file:
            data = hard_linked(file, "data")
            names = [] if data is None else episode_names(where, data, "demo_")
            if not names:
                raise CaptureError(f"{where}: has no demonstration; this layout needs {self.needs}")
            first = data[names[0]]
            obs = arrays_below(f"{where}: {names[0]}", first, "obs")
            cameras = _cameras(obs)
            if not cameras:
                raise CaptureError(
                    f"{where}: {names[0]} has no depth; extract it by robomimic's dataset_states_to_obs.py --depth "
                    "--camera_names NAME"
                )
            self._depth_is, self._rows = _stated_images(where, data, first, depth_values, rows)
            self._labels = _label_arrays(where, obs, check_name(where, "labels_from", labels_from))
            demonstrations = _demonstrations(where, data, names, cameras)
            chosen, told = self._chosen(where, first, cameras, camera)
            streams = _streams(obs, _others(where, first), self._stated.frame_id)
            if not self._knows_world(where, first, chosen):
                streams, lost = without_frame(streams, signals)
                told += lost
        super().__init__(
            path,
            demonstrations,
            streams,
            cameras=chosen,
            signals=signals,
            frame_id=self._stated.frame_id,
            skipped={},
            unread=[*told, *_untold(obs, self._labels)],
        )

    @classmethod
    def _is_such(cls, file: Any) -> bool:
        data = hard_linked(file, "data")
        return data is not None and bool(episode_names("recognizes", data, "demo_"))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_last": None}

    def _chosen(self, where: str, first: Any, cameras: list[str], camera: str | None) -> tuple[list[str], list[str]]:
        """Return the cameras that are read, and what is said of the others."""
        named = cameras if camera is None else [one_of(where, "camera", camera, cameras)]
        known = known_cameras(where, first, named, self._stated).cameras
        if self._stated.numbers is not None and len(named) > 1:
            raise ConfigError(f"{where}: intrinsics are of one camera; say which: camera={named[0]}")
        for name in named:
            if known[name].camera is None:
                raise IntrinsicsError(
                    f"{where}: nothing states the intrinsics of the camera {name!r}: its demonstrations have no "
                    f"camera_info and no model_file that tells its fovy. Say camera={name} intrinsics=(fx, fy, cx, cy) "
                    f"(--camera {name} --intrinsics FX FY CX CY), or calibration=FILE with a camera of that name"
                )
        if len(named) == 1:
            return named, unread_cameras(cameras, named)
        posed = [name for name in named if known[name].pose is not None]
        if not posed:
            raise CaptureError(
                f"{where}: holds depth of {', '.join(named)}, whose poses nothing states, so they are no views of one "
                f"frame; say which to read: camera={named[0]} (--camera {named[0]}), or give calibration"
            )
        return posed, [
            f"camera {name}: its poses are not in the file; camera={name} (--camera {name}) reads it alone"
            for name in named
            if name not in posed
        ]

    def _knows_world(self, where: str, first: Any, chosen: list[str]) -> bool:
        """Whether the poses lead to the frame of the simulator, where its positions are."""
        known = self._stated.calibration
        elsewhere = known is not None and known.transforms and any(name in known.cameras for name in chosen)
        views = known_cameras(where, first, chosen, self._stated).cameras.values()
        return not elsewhere and all(view.pose is not None for view in views)

    def _view(self, steps: Steps, camera: str, sample_id: str) -> DepthFrame:
        if self._last is None or self._last[0] != steps.where:
            self._last = (steps.where, known_cameras(steps.where, steps.group, self.cameras, self._stated))
        view, near, far = self._last[1].cameras[camera], self._last[1].near, self._last[1].far
        if view.camera is None:
            raise IntrinsicsError(f"{steps.where}: nothing states the intrinsics of the camera {camera!r}")
        where = f"{steps.where}/obs/{camera}{_DEPTH}"
        stored = self._upright(plane_of(steps, f"obs/{camera}{_DEPTH}"))
        facts: dict[str, Any] = {"demonstration": steps.demonstration.group, "depth_values": self._depth_is}
        if self._depth_is == "z_buffer":
            check_planes(f"{where}: is a renderer's buffer, which", near or 0.0, far or 0.0)
            assert near is not None
            assert far is not None
            depth = z_of_rendered(where, torch.from_numpy(stored), "z_buffer", near, far)
            facts |= {"near_far": [near, far], "metres_per_unit": 1.0, "unit_is_recorded": True}
        else:
            metres = depth_in_metres(where, stored, None)
            if far is not None:
                metres[metres >= far * _AT_FAR] = 0.0
            depth = torch.from_numpy(metres)
        images: dict[str, Tensor] = {}
        if steps.has(f"obs/{camera}{_COLOR}"):
            images["color"] = torch.from_numpy(self._upright(color_of(steps, f"obs/{camera}{_COLOR}")))
        if camera in self._labels:
            images["labels"] = torch.from_numpy(self._upright(plane_of(steps, self._labels[camera])).astype(np.int64))
        if view.pose is None:
            facts["missing"] = [
                f"the pose of the camera {camera} is in no file: points are in the frame of the camera; give it by "
                "calibration, or read cameras that stand still"
            ]
        frame = make_frame(
            {"depth": self.path},
            depth=depth,
            camera=view.camera((depth.shape[0], depth.shape[1])),
            sample_id=sample_id,
            frame_id=self.frame_id,
            capture_index=0,
            provenance={**self.provenance(sample_id), **facts},
            background_label=self._label,
            images=images,
        )
        return frame if view.pose is None else replace(frame, world_from_camera=view.pose[None], frame_id=self.frame_id)

    def _upright(self, image: NDArray[Any]) -> NDArray[Any]:
        return np.ascontiguousarray(image[::-1] if self._rows == "bottom_first" else image)


def _cameras(obs: Shapes) -> list[str]:
    return in_order(name.removeprefix("obs/").removesuffix(_DEPTH) for name in obs if name.endswith(_DEPTH))


def _demonstrations(where: str, data: Any, names: Sequence[str], cameras: list[str]) -> dict[str, Demonstration]:
    said = json_attribute(where, data, "env_args")
    seconds = seconds_of_rate(said.get("env_kwargs"))
    facts = {key: said[key] for key in ("env_name", "env_version") if isinstance(said.get(key), str)}
    found = {}
    for name in names:
        group, own = data[name], f"{where}: {name}"
        obs = arrays_below(own, group, "obs")
        same_cameras(where, cameras, _cameras(obs), name)
        length = check_lengths(own, {path: shape for path, shape in obs.items() if path.endswith(_DEPTH)})
        words = json_attribute(own, group, "ep_meta").get("lang")
        texts = {"task": words} if isinstance(words, str) and words else {}
        found[name] = Demonstration(f"data/{name}", length, facts, texts, seconds)
    return found


def _stated_images(where: str, data: Any, first: Any, depth: str | None, rows: str | None) -> tuple[str, str]:
    """Return what the depth is and which row is first, as the options or the file say.

    Raises:
        ConfigError: neither does.
    """
    for option, value, known in (("depth_values", depth, _DEPTH_IS), ("rows", rows, ROWS)):
        if value is not None and value not in known:
            hint = near_matches(str(value), known)
            raise ConfigError(f"{where}: {option} must be {' or '.join(known)}{hint}, got {value!r:.60}")
    if "camera_info" in first.attrs:  # written by the extraction that writes metres and the top row first
        return depth or "z", rows or "top_first"
    said = text_attribute(where, data, "image_convention")  # robosuite's own words, of macros.IMAGE_CONVENTION
    rows = rows or {"opengl": "bottom_first", "opencv": "top_first"}.get(said or "")
    unsaid = [] if depth else ["whether depth is metres (depth_values=z) or a buffer (depth_values=z_buffer)"]
    unsaid += [] if rows else ["which row of the images is first (rows=top_first or bottom_first)"]
    if depth is None or rows is None:
        raise ConfigError(
            f"{where}: the file has no camera_info, so robomimic did not extract it, and nothing says "
            f"{' and '.join(unsaid)}. Robosuite's observations as they are: --depth-values z_buffer --rows "
            'bottom_first, or top_first where macros.IMAGE_CONVENTION was "opencv"; after '
            "get_real_depth_map: --depth-values z"
        )
    return depth, rows


def _label_arrays(where: str, obs: Shapes, chosen: str | None) -> dict[str, str]:
    """Return the array of labels of each camera."""
    found: dict[str, dict[str, str]] = {}
    for path in obs:
        camera, mark, level = path.removeprefix("obs/").rpartition(_LABELS)
        if mark:
            found.setdefault(level, {})[camera] = path
    if chosen is not None and chosen not in found:
        raise ConfigError(
            f"{where}: labels_from must be a segmentation that is there ({name_some(found) or 'there is none'}), got "
            f"{chosen!r}"
        )
    return found[chosen] if chosen else next(iter(found.values())) if len(found) == 1 else {}


def _streams(obs: Shapes, others: Shapes, world: str) -> dict[str, Stream]:
    """Return the signals: what has one row of numbers a step."""
    found: dict[str, Stream] = {}
    for path, shape in obs.items():
        name = path.removeprefix("obs/")
        if len(shape) in (1, 2) and not name.endswith((_DEPTH, _COLOR)) and _LABELS not in name:
            found[name] = Stream((path,))
    for name in [name for name in found if name.endswith("_eef_pos") and obs[f"obs/{name}"][1:] == (3,)]:
        stem = name.removesuffix("_pos")
        if f"{stem}_quat" in found and obs[f"obs/{stem}_quat"][1:] == (4,):
            # A rotation has no kind of its own; as numbers that nothing moves it would be wrong in a turned cloud.
            del found[name], found[f"{stem}_quat"]
            found[f"{stem}_pose"] = Stream((f"obs/{name}", f"obs/{stem}_quat"), ("pose xyz_quat_xyzw", world))
        else:
            found[name] = Stream((f"obs/{name}",), ("position", world))
    return found | {_OTHERS[path]: Stream((path,)) for path, shape in others.items() if len(shape) in (1, 2)}


def _others(where: str, first: Any) -> dict[str, tuple[int, ...]]:
    return {path: shape for name in _OTHERS for path, shape in arrays_below(where, first, name).items() if path == name}


def _untold(obs: Shapes, labels: Mapping[str, str]) -> list[str]:
    levels = sorted({path.rpartition(_LABELS)[2] for path in obs if _LABELS in path})
    if labels or not levels:
        return []
    return [f"{len(levels)} kinds of segmentation, {', '.join(levels)}: labels_from={levels[0]} reads one as labels"]
