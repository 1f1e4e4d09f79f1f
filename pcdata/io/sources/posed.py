"""Captures whose cameras stand where a file says: ``{"file": "cam2base_extrinsics.json", "episode": ..., ...}``.

Better extrinsics are often published, or measured, after a recording: they go around whatever reads it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from pcdata.errors import CaptureError, ConfigError, DTypeError, FrameError
from pcdata.files.inputs import Inputs, recording
from pcdata.files.sample_names import check_known, name_some
from pcdata.io.calibration.calibration_yaml import read_calibration
from pcdata.io.calibration.droid import read_droid_extrinsics
from pcdata.io.sources.capture_source import CaptureSource, checked_ids, episodes_of
from pcdata.io.sources.combine import DerivedSource
from pcdata.io.sources.registry import register_combinator
from pcdata.structures import DepthFrame

_WHERE = "posed"
_Poses = dict[str, Tensor]  # by camera: (4, 4) float64, the frame from it


@register_combinator
@dataclass(frozen=True, kw_only=True)
class _PosedSource(DerivedSource):
    """Captures whose poses are those of a file; cameras that it does not have keep their own.

    A camera is found by its name or serial number, as ``provenance["cameras"]`` or ``provenance["serial"]`` has it.

    Args:
        source: the captures.
        file: a ``.json`` of extrinsics as DROID's authors publish them, by episode and serial; or a calibration file.
        frame_id: the frame that they lead to.
        episode: whose extrinsics, of a file with several; "" = those of the episode that a capture belongs to.
        camera: what the file calls the camera of captures with one view, where they do not say its name.
    """

    kind: ClassVar[str] = "posed"

    source: CaptureSource
    file: str = ""  # must be given
    frame_id: str = "base"
    episode: str = ""
    camera: str = ""
    inputs: Inputs = field(init=False, repr=False, compare=False)
    _poses: Mapping[str | None, _Poses] = field(init=False, repr=False, compare=False)
    _episode_of: Mapping[str, str] = field(init=False, repr=False, compare=False)  # by sample id

    def __post_init__(self) -> None:
        if not isinstance(self.file, (str, os.PathLike)) or not str(self.file):
            raise ConfigError(f"{_WHERE}: file must be the path of a file of poses, got {self.file!r:.100}")
        for option in ("frame_id", "episode", "camera"):
            object.__setattr__(self, option, _text(option, getattr(self, option)))
        if not self.frame_id:
            raise ConfigError(f"{_WHERE}: frame_id must name the frame that the poses lead to, such as base")
        checked_ids(_WHERE, self.source)
        inputs = Inputs()
        with recording(inputs):
            poses = self._read()
        object.__setattr__(self, "inputs", inputs)
        object.__setattr__(self, "_poses", poses)
        ids, episodes = self.source.ids, [] if None in poses else episodes_of(self.source)
        object.__setattr__(self, "_episode_of", {ids[place]: one.id for one in episodes for place in one.steps})

    def _read(self) -> dict[str | None, _Poses]:
        """Return the poses by episode; by None where they are the same for all captures."""
        path = Path(self.file).expanduser()
        where = f"{_WHERE}: {path}"
        if not path.is_file():
            raise ConfigError(f"{where}: no such file of poses; check the path (relative to {Path.cwd()})")
        if path.suffix.lower() != ".json":
            if self.episode:
                raise ConfigError(f"{where}: a calibration has no episodes; leave out episode")
            calibration = read_calibration(path)
            found: dict[str, Tensor] = {}
            for name in calibration.cameras:
                try:
                    found[name] = calibration.transform(self.frame_id, name)
                except FrameError:
                    continue
            if not found:
                raise CaptureError(
                    f"{where}: leads from none of its cameras to {self.frame_id!r}; name another frame_id"
                )
            return {None: found}
        wanted = [one.id for one in episodes_of(self.source)] if not self.episode else [self.episode]
        return read_droid_extrinsics(where, path, wanted, is_stated=bool(self.episode))

    def unread(self) -> list[str]:
        """Say which episodes keep the poses that they have, besides what the source does not read."""
        poses = self._poses
        lacking = [] if None in poses else [one.id for one in episodes_of(self.source) if one.id not in poses]
        told = [f"{Path(self.file).name} has no poses for {name_some(lacking)}: they keep theirs"] if lacking else []
        return [*told, *super().unread()]

    def made_of(self, sample_id: str) -> list[tuple[CaptureSource, str]]:
        """Return the capture that gets other poses.

        Raises:
            CaptureError: no sample has this id.
        """
        check_known(_WHERE, sample_id, frozenset(self.source.ids))
        return [(self.source, sample_id)]

    def load(self, sample_id: str) -> DepthFrame:
        """Load a capture and put the poses of the file in place of its own.

        Raises:
            CaptureError: no sample has this id, or a camera has no pose in the file and none of its own.
            FrameError: the poses that it keeps lead to another frame.
            DTypeError: it is no depth frame.
        """
        ((source, own),) = self.made_of(sample_id)
        frame = source.load(own)
        if not isinstance(frame, DepthFrame):
            raise DTypeError(f"{_WHERE}: poses are of cameras, but the source holds point clouds; leave it out")
        poses = self._poses_at(sample_id)
        names = self._names(frame)
        found = [next((poses[name] for name in called if name in poses), None) for called in names]
        lacking = [called[0] for called, pose in zip(names, found) if pose is None]
        kept = frame.world_from_camera
        if lacking and ((len(lacking) == len(names) and poses) or kept is None):
            raise CaptureError(
                f"{_WHERE}: {Path(self.file).name} has no pose of {name_some(lacking)} for capture {sample_id!r}; it "
                f"has {name_some(poses) or 'none'}; camera=NAME (--option posed.camera=NAME) says what it calls the "
                "camera of captures with one view"
            )
        if lacking and frame.frame_id != self.frame_id:
            raise FrameError(
                f"{_WHERE}: capture {sample_id!r}: {name_some(lacking)} would keep a pose in {frame.frame_id!r} beside "
                f"others in {self.frame_id!r}; say frame_id={frame.frame_id!r} if the file's lead there too"
            )
        device = frame.depth.device
        stacked = torch.stack(
            [
                pose.to(device) if pose is not None else kept[view].double()  # type: ignore[index]
                for view, pose in enumerate(found)
            ]
        )
        told = [called[0] for called, pose in zip(names, found) if pose is not None]
        facts = {"file": Path(self.file).name, "cameras": told}
        return replace(
            frame,
            world_from_camera=stacked,
            frame_id=self.frame_id,
            provenance={**frame.provenance, "posed": facts},
        )

    def _poses_at(self, sample_id: str) -> _Poses:
        if None in self._poses:
            return self._poses[None]
        return self._poses.get(self._episode_of.get(sample_id), {})

    def _names(self, frame: DepthFrame) -> list[list[str]]:
        """Return what each view's camera is called, the likeliest first."""
        said: Any = frame.provenance.get("cameras", ())
        names = [[str(name)] for name in said] if len(said) == frame.num_views else [[] for _ in range(frame.num_views)]
        if frame.num_views == 1:
            said = [self.camera, *names[0], frame.provenance.get("camera"), frame.provenance.get("serial")]
            names[0] = [str(name) for name in said if name]
        return [called or [f"view {view}"] for view, called in enumerate(names)]


def _text(option: str, value: Any) -> str:
    """Return a name; a serial number may come as the number that YAML takes it for."""
    if isinstance(value, int) and not isinstance(value, bool) and value > 0:
        return str(value)
    if not isinstance(value, str):
        raise ConfigError(f"{_WHERE}: {option} must be a name, got {value!r:.100}")
    return value
