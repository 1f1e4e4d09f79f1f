"""RISE: images, poses of the tool and gripper commands per episode, with a calibration that leads to the camera.

Source: rise-policy/RISE, ``dataset/realworld.py`` (RealWorldDataset), ``dataset/projector.py``,
``dataset/constants.py``, ``README.md``.
"""

from __future__ import annotations

import io
import json
import pickle
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.errors import CaptureError, ConfigError, near_matches
from pcdata.exports.class_table import Given, in_splits, read_table, with_splits
from pcdata.exports.episode_signals import signal_row
from pcdata.exports.exported_images import Fields, image_fields, stored_colors, stored_depth
from pcdata.exports.model_contracts import require_depth
from pcdata.exports.registry import register_target
from pcdata.exports.sample_needs import colors_of, one_view
from pcdata.exports.target import Item, Note, Samples, Target
from pcdata.files.npy import write_npy
from pcdata.files.opening import read_text
from pcdata.geometry import rigid, rotations
from pcdata.io.images.writing import depth_units, write_color, write_depth
from pcdata.io.store.sample_keys import key_of
from pcdata.structures import CAMERA_FRAME, DepthFrame, Episode, PointCloud
from pcdata.structures.pose_layouts import LAYOUTS

# Of dataset/constants.py: the camera at the tool, and where it is mounted. The projector goes by way of it.
_INHAND_CAMERA = "043322070878"
_TOOL_FROM_INHAND = ((0.0, -1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.077), (0.0, 0.0, 1.0, 0.2665), (0.0, 0.0, 0.0, 1.0))
_OPEN = 0.095  # metres at a gripper command of 1000
_FIRST_STAMP = 10**12  # milliseconds: names are sorted as texts, so all have as many digits
_STEP = 100  # milliseconds between steps whose times are not known
_STAMP = "timestamp.txt"
_INTRINSICS = "intrinsics.txt"
_SAME = 1e-9  # a pose that differs by less is the same


class _Step(NamedTuple):
    """What is written of one timestep."""

    frame: DepthFrame
    tcp: NDArray[np.float64]  # (7,) x y z, quaternion w x y z
    gripper: NDArray[np.float64]  # (1,) command


@register_target
@dataclass(frozen=True, kw_only=True)
class _Rise(Target):
    """``{train,val}/EPISODE/cam_SERIAL/...`` and ``calib/STAMP/``; give the folder to the loader as ``path``.

    Poses and widths are signals of the captures. Every episode has a calibration of its own: its camera stands still.

    Args:
        tcp: the signal with the pose of the tool, "pose LAYOUT" in the robot's frame or the camera's.
        gripper: the signal with the width of the gripper in metres, one number.
        camera: the serial number that the loader is given as ``cam_ids``; depth is in millimetres, or in units of
            0.25 mm where the number has an "f" in it, as the loader takes it.
        table: split (train or val) of every episode, whose name stands for a sample's; None = all are train.
        view: which view, of captures with several.
        round_depth: round depth between two units, which loses up to half a unit.
    """

    name: ClassVar[str] = "rise"
    takes: ClassVar[Literal["captures"]] = "captures"
    model: ClassVar[str] = "rise"
    left_to_loader: ClassVar[frozenset[str]] = frozenset({"crop"})
    layout: ClassVar[str] = "train/EPISODE/cam_SERIAL/: color, depth, tcp, gripper_command; calib/STAMP/"
    of_episodes: ClassVar[bool] = True

    tcp: str = "tcp"
    gripper: str = "gripper"
    camera: str = "750612070851"
    table: Given | None = None
    view: int | None = None
    round_depth: bool = False

    @property
    def units_per_metre(self) -> int:
        """Return how the loader reads the depth of this camera."""
        return _units_per_metre(self.camera)

    def with_splits(self, part_of: Mapping[str, str]) -> Target:
        """Take the splits into the table."""
        return replace(self, table=with_splits(self.name, self.table, part_of))

    def items(self, ids: Sequence[str]) -> list[Item]:
        """One item per episode, of which the ids alone tell nothing."""
        return self.plan(ids, (), ())

    def plan(self, ids: Sequence[str], episodes: Sequence[Episode], left_out: Collection[str]) -> list[Item]:
        """Whole episodes alone: one with a step that does not fit is left out."""
        if not self.camera.isalnum() or self.camera == _INHAND_CAMERA:
            raise ConfigError(
                f"rise: camera must be letters and digits, and not {_INHAND_CAMERA!r}, which is the one at the tool, "
                f"got {self.camera!r:.100}"
            )
        if not episodes:
            raise ConfigError(
                "rise: needs to know which captures make an episode, and the source does not say: put episodes.json "
                "beside the captures (pcdata.write_episodes)"
            )
        splits = {one.id: "train" for one in episodes}
        if self.table is not None:
            rows = read_table(self.name, self.table, list(splits), needs=["split"])
            parts = in_splits(self.name, rows, ("train", "val"))
            splits = {name: split for split, names in parts.items() for name in names}
        items = []
        for number, one in enumerate(episodes):
            names = tuple(ids[one.first : one.first + one.length])
            if not any(sample_id in left_out for sample_id in names):
                paths = (f"calib/{_FIRST_STAMP + number}", f"{splits[one.id]}/{key_of(one.id)}")
                items.append(Item(names, paths, (Episode(one.id, 0, one.length, one.times),)))
        return items

    def examine(self, item: Item, sample_id: str, data: DepthFrame | PointCloud, seen: dict[str, Any]) -> _Step:
        """Return the view with its pose of the tool, from a camera that stands where it stood before."""
        where = f"rise: sample {sample_id!r}"
        frame = one_view(where, data, self.view)
        require_depth(where, self, frame)
        colors_of(where, frame)
        unit = 1 / self.units_per_metre
        try:
            depth_units(where, frame.depth[0], metres_per_unit=unit, round_to_unit=self.round_depth)
        except CaptureError as error:
            raise CaptureError(f"{error}; the loader reads units of {unit:g} m: say round_depth=true") from error
        tcp, camera_from_base = self._tcp(where, frame, seen.get("tcp"))
        seen["tcp"] = tcp
        width = signal_row(where, frame, "gripper", self.gripper)
        if width.shape != (1,) or not 0 <= float(width[0]) < 1:
            raise CaptureError(f"{where}: gripper must be one width in metres, 0 to 1, got {width.tolist()!r:.100}")
        same = seen.setdefault("pose", camera_from_base)
        intrinsics = seen.setdefault("intrinsics", frame.camera.intrinsics[0])
        if bool((same - camera_from_base).abs().max() > _SAME) or not torch.equal(
            intrinsics, frame.camera.intrinsics[0]
        ):
            raise CaptureError(
                f"{where}: the camera moved, or has other intrinsics, within episode {item.episodes[0].id!r}, and RISE "
                "has one calibration for all of it; choose the view of a camera that stands still: view=N"
            )
        return _Step(frame, tcp, width.astype(np.float64) / _OPEN * 1000)

    def _tcp(
        self, where: str, frame: DepthFrame, before: NDArray[np.float64] | None
    ) -> tuple[NDArray[np.float64], Tensor]:
        signals = frame.recorded_signals
        if self.tcp not in signals:
            raise CaptureError(
                f"{where}: tcp is the signal {self.tcp!r}, which the capture has not{near_matches(self.tcp, signals)}; "
                f"its signals are: {', '.join(signals) or 'none'}; attach it (with_signal), or say tcp=NAME"
            )
        signal = signals[self.tcp]
        kind, _, layout = signal.kind.partition(" ")
        if kind != "pose" or " " in layout or not isinstance(signal.values, Tensor) or signal.values.ndim > 3:
            raise CaptureError(
                f"{where}: tcp must be a 'pose LAYOUT' of one step, but the signal {self.tcp!r} is {signal!r}"
            )
        values = signal.values[0].double()
        position, quaternion, is_recorded = _position_and_quaternion(layout, values)
        if position is None:
            raise CaptureError(
                f"{where}: tcp must be a pose, but the signal {self.tcp!r} is a rotation alone: {signal!r}"
            )
        if position.shape != (3,):
            raise CaptureError(f"{where}: tcp must be one pose, but the signal {self.tcp!r} is {signal!r}")
        if before is not None and not is_recorded:
            quaternion = rotations.nearest_sign(quaternion, torch.from_numpy(before[3:]))
        pose = torch.cat([position, quaternion]).numpy()
        if signal.frame == CAMERA_FRAME:
            return pose, torch.eye(4, dtype=torch.float64, device="cpu")
        assert frame.world_from_camera is not None  # a capture knows the frames of its signals
        return pose, rigid.invert_rigid(frame.world_from_camera[:1])[0]

    def write(self, item: Item, samples: Samples, folder: Path, note: Note) -> None:
        """Write one episode and its calibration."""
        calibration, path = (folder / place for place in item.paths)
        camera = path / f"cam_{self.camera}"
        for name in ("color", "depth", "tcp", "gripper_command"):
            (camera / name).mkdir(parents=True)
        stamps = _stamps(item.episodes[0])
        seen: dict[str, Any] = {}
        for stamp, (sample_id, data) in zip(stamps, samples):
            step = self.examine(item, sample_id, data, seen)
            write_color(camera / f"color/{stamp}.png", torch.from_numpy(colors_of(self.name, step.frame)))
            write_depth(
                camera / f"depth/{stamp}.png",
                step.frame.depth[0],
                metres_per_unit=1 / self.units_per_metre,
                round_to_unit=self.round_depth,
            )
            write_npy(camera / f"tcp/{stamp}.npy", step.tcp)
            write_npy(camera / f"gripper_command/{stamp}.npy", step.gripper)
        next(samples, None)  # at its end the last sample is counted
        (path / "metadata.json").write_text(json.dumps({"finish_time": stamps[-1]}) + "\n", "utf-8")
        (path / _STAMP).write_text(f"{calibration.name}\n", "utf-8")
        self._write_calibration(calibration, seen["pose"], seen["intrinsics"])
        (fx, _, cx), (_, fy, cy), _ = seen["intrinsics"].tolist()
        note(
            f"the loader does not read intrinsics: put [[{fx:.9g}, 0, {cx:.9g}, 0], [0, {fy:.9g}, {cy:.9g}, 0], "
            f"[0, 0, 1, 0]] into INTRINSICS[{self.camera!r}] of its dataset/constants.py, and leave INHAND_CAM and "
            "INHAND_CAM_TCP there as they are"
        )
        if len(stamps) == 1:
            note("some episodes are one step long: the loader makes no sample of them, since actions follow a step")

    def _write_calibration(self, folder: Path, camera_from_base: Tensor, intrinsics: Tensor) -> None:
        """Write matrices by which the projector finds the camera.

        It multiplies marker matrix of the camera, inverse of that of the camera at the tool, mounting of that camera,
        inverse of the tool's pose: here camera from base, inverse mounting, mounting, identity.
        """
        folder.mkdir(parents=True)
        mounting = torch.tensor(_TOOL_FROM_INHAND, dtype=torch.float64, device="cpu")
        matrices = {self.camera: camera_from_base[None].numpy(), _INHAND_CAMERA: mounting[None].numpy()}
        _write_mapping(folder / "extrinsics.npy", matrices)
        wide = torch.cat([intrinsics.double(), torch.zeros(3, 1, dtype=torch.float64, device="cpu")], dim=1)
        _write_mapping(folder / "intrinsics.npy", {self.camera: wide.numpy()})
        # For people and for check: the loader opens none, and what is pickled beside it nobody should have to.
        np.savetxt(folder / _INTRINSICS, intrinsics.double().numpy(), fmt="%.17g")
        write_npy(folder / "tcp.npy", np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))

    @classmethod
    def cloud_fields(cls, folder: Path, names: Sequence[str]) -> Iterator[tuple[str, Fields]]:
        """Read the views of which the depth is among the files."""
        for name in names:
            if PurePath(name).match("*/*/cam_*/depth/*.png"):
                depth = folder / name
                camera, episode = depth.parents[1], depth.parents[2]
                stamp = read_text("check", episode / _STAMP, inside=[folder]).strip()
                serial = camera.name.removeprefix("cam_")
                text = read_text("check", folder / f"calib/{stamp}/{_INTRINSICS}", inside=[folder])
                matrix = np.array([line.split() for line in text.splitlines()], dtype=np.float64)
                pixels = stored_depth(folder, depth, _units_per_metre(serial))
                colors = stored_colors(folder, camera / f"color/{depth.name}")
                yield f"{episode.name}/{depth.stem}", image_fields(depth, pixels, matrix, colors)


def _units_per_metre(camera: str) -> int:
    """Return how the loader reads the depth of a camera."""
    return 4000 if "f" in camera else 1000


def _position_and_quaternion(name: str, values: Tensor) -> tuple[Tensor | None, Tensor, bool]:
    """Return x y z and the quaternion w x y z of one pose, and whether it stays as it was recorded."""
    layout = LAYOUTS[name]
    position, part = layout.parts(values)
    if name.endswith("quat_wxyz"):
        return position, part, True
    if name.endswith("quat_xyzw"):
        return position, part.roll(1, -1), True
    return position, rotations.quaternion_from_rotation(layout.rotation(part)), False


def _stamps(episode: Episode) -> list[int]:
    """Return a whole number of milliseconds for every step, each later than the one before."""
    if not episode.times:
        return [_FIRST_STAMP + _STEP * number for number in range(episode.length)]
    stamps: list[int] = []
    for time in episode.times:
        wanted = _FIRST_STAMP + round(1000 * (time - episode.times[0]))
        stamps.append(max(wanted, stamps[-1] + 1) if stamps else wanted)
    return stamps


def _write_mapping(path: Path, arrays: Mapping[str, NDArray[np.float64]]) -> None:
    """Write names and arrays as the loader reads them, which is a pickled dict: nothing here reads such a file.

    From version 2 on NumPy pickles arrays by a name that the versions which RISE was written for do not have; both know
    the old one. In protocol 3 a name is a line of text, so it is put in place of the other.
    """
    content = np.array(dict(arrays), dtype=object)
    pickled = pickle.dumps(content, protocol=3).replace(b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n")
    packed = io.BytesIO()
    np.lib.format.write_array_header_1_0(packed, np.lib.format.header_data_from_array_1_0(content))
    packed.write(pickled)
    path.write_bytes(packed.getbuffer())
