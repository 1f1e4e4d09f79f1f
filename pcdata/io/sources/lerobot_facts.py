"""``meta/pcdata.json``: what a LeRobot dataset that pcdata wrote says besides the format, which has no place for it.

Cameras with the unit of their depth and what it is registered to, the kind and frame of every signal, names and
attributes of episodes. Whoever does not know the file reads the dataset all the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, get_args

import torch

from pcdata.errors import CaptureError, PcdataError
from pcdata.geometry.lens_models import model_named
from pcdata.io.sources.lerobot_cameras import DepthStream, Feature, Storage
from pcdata.structures.signal_kinds import parse_kind

FACTS = "meta/pcdata.json"
IMAGES = ("labels", "mask", "confidence")
SCHEMA = 1
DTYPES = {
    str(dtype).removeprefix("torch."): dtype
    for dtype in (
        torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.uint8, torch.int8, torch.int16, torch.int32,
        torch.int64, torch.bool,
    )
}  # fmt: skip


@dataclass(frozen=True)
class CameraFacts:
    """One view: columns and keys of videos by what they hold; None = there is none."""

    name: str
    depth: str
    storage: Storage
    size: tuple[int, int]
    intrinsics: str
    metres_per_unit: float | None = None  # None = floats in metres
    registered_to: str | None = None
    color: str | None = None
    distortion: str | None = None
    world_from_camera: str | None = None
    is_window: bool = False
    lens: str | None = None  # the model of what distortion holds; None = OpenCV's polynomial
    images: Mapping[str, str] = field(default_factory=dict)  # see DepthStream

    def stream(self) -> DepthStream:
        """Return it as the reader has cameras."""
        return DepthStream(
            camera=self.name,
            key=self.depth,
            storage=self.storage,
            metres_per_unit=1.0 if self.metres_per_unit is None else self.metres_per_unit,
            size=self.size,
            color=self.color,
            intrinsics=self.intrinsics,
            distortion=self.distortion,
            is_window=self.is_window,
            lens=self.lens,
            images=self.images,
            extrinsics=self.world_from_camera,
            direction=None if self.world_from_camera is None else "camera_to_frame",
            facts={} if self.registered_to is None else {"registered_to": self.registered_to},
        )


@dataclass(frozen=True)
class SignalFacts:
    """One signal: its column (None = the text of the task), and what cannot be told from that."""

    column: str | None
    kind: str
    frame: str | None = None
    dtype: str | None = None  # None = text
    shape: tuple[int, ...] = ()  # of one step


@dataclass(frozen=True)
class EpisodeFacts:
    """One episode; ``is_episode`` is False where the captures between episodes had to be one."""

    id: str
    is_episode: bool = True
    attributes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class DatasetFacts:
    """All of the file."""

    frame_id: str | None
    cameras: tuple[CameraFacts, ...]
    signals: Mapping[str, SignalFacts]
    episodes: tuple[EpisodeFacts, ...]
    time: str | None = None  # the column with the seconds of each step
    derived: tuple[str, ...] = ()  # columns that repeat signals

    def as_json(self) -> dict[str, Any]:
        """Return plain data for :func:`facts_of_json`."""
        return {"schema": SCHEMA, **asdict(self)}


def facts_of_json(where: str, said: Mapping[str, Any], features: Mapping[str, Feature]) -> DatasetFacts:
    """Read the file.

    Raises:
        CaptureError: it is of another schema, or says what the dataset does not have or cannot be.
    """
    if said.get("schema") != SCHEMA:
        raise CaptureError(
            f"{where}: {FACTS} is of schema {said.get('schema')!r:.40}, this pcdata reads {SCHEMA}; update pcdata"
        )
    try:
        facts = DatasetFacts(
            frame_id=said["frame_id"],
            cameras=tuple(CameraFacts(**{**one, "size": tuple(one["size"])}) for one in said["cameras"]),
            signals={
                name: SignalFacts(**{**one, "shape": tuple(one["shape"])}) for name, one in said["signals"].items()
            },
            episodes=tuple(EpisodeFacts(**one) for one in said["episodes"]),
            time=said["time"],
            derived=tuple(said["derived"]),
        )
        _check(facts, features)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        if isinstance(error, PcdataError):
            raise CaptureError(f"{where}: {FACTS}: {error}") from error
        raise CaptureError(
            f"{where}: {FACTS} is not as pcdata writes it: {type(error).__name__}: {error!s:.200}"
        ) from error
    return facts


def _check(facts: DatasetFacts, features: Mapping[str, Feature]) -> None:
    columns: list[Any] = [facts.time, *facts.derived]
    for camera in facts.cameras:
        if camera.storage not in get_args(Storage) or not _texts(camera.name, camera.depth, camera.intrinsics):
            raise CaptureError(f"camera {camera.name!r:.100} is not described")
        if len(camera.size) != 2 or not all(isinstance(side, int) and 0 < side < 1 << 20 for side in camera.size):
            raise CaptureError(f"camera {camera.name!r:.100}: size must be height and width, got {camera.size!r:.60}")
        unit = camera.metres_per_unit
        if unit is not None and not (isinstance(unit, (int, float)) and 0 < unit < 1000):
            raise CaptureError(f"camera {camera.name!r:.100}: metres_per_unit must be metres, got {unit!r:.60}")
        if not isinstance(camera.is_window, bool):
            raise CaptureError(f"camera {camera.name!r:.100}: is_window must be true or false")
        if camera.lens is not None and (not _texts(camera.lens) or model_named(camera.lens) is None):
            raise CaptureError(f"camera {camera.name!r:.100}: lens must be a known model, got {camera.lens!r:.60}")
        if not set(camera.images) <= set(IMAGES) or not _texts(*camera.images.values()):
            raise CaptureError(f"camera {camera.name!r:.100}: images must be keys of {', '.join(IMAGES)}")
        if camera.storage in ("image", "array"):
            columns.append(camera.depth)
        columns += [camera.intrinsics, camera.color, camera.distortion, camera.world_from_camera]
    if not facts.cameras:
        raise CaptureError("lists no camera")
    if facts.frame_id is not None and not _texts(facts.frame_id):
        raise CaptureError(f"frame_id must be a text, got {facts.frame_id!r:.60}")
    for name, signal in facts.signals.items():
        kind = parse_kind(signal.kind)
        if kind.is_text != (signal.dtype is None) or (signal.dtype is not None and signal.dtype not in DTYPES):
            raise CaptureError(f"signal {name!r:.100}: {signal.kind} of dtype {signal.dtype!r:.60}")
        if signal.column is None and not kind.is_text:
            raise CaptureError(f"signal {name!r:.100} names no column")
        if not all(isinstance(side, int) and 0 <= side < 1 << 31 for side in signal.shape):
            raise CaptureError(f"signal {name!r:.100}: shape {signal.shape!r:.60}")
        columns.append(signal.column)
    for episode in facts.episodes:
        if not _texts(episode.id) or not isinstance(episode.is_episode, bool):
            raise CaptureError(f"episode {episode.id!r:.100} is not described")
    for column in columns:
        if column is not None and (not isinstance(column, str) or column not in features):
            raise CaptureError(f"names the feature {column!r:.100}, which the dataset does not have")


def _texts(*values: Any) -> bool:
    return all(isinstance(value, str) and value for value in values)
