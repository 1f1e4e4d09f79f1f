"""A recording on the clock of its first depth camera: each depth image with all that belongs to it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.errors import CaptureError, PcdataError, add_note
from pcdata.functional.depth.stored_depth import check_plausible, clean_float_depth, metres_of_numbers
from pcdata.functional.depth.unit_fit import DepthUnit
from pcdata.io.messages.camera_streams import (
    RECORDED,
    CameraStream,
)
from pcdata.io.messages.cameras import camera_of
from pcdata.io.messages.decoding import decoded
from pcdata.io.messages.images import color_pixels, depth_numbers, plain_numbers
from pcdata.io.messages.joined_topics import JoinedTopics
from pcdata.io.messages.signal_streams import SignalStream
from pcdata.io.sources.joined_views import join_views
from pcdata.io.sources.stated_kinds import signal_of
from pcdata.io.sources.synchronized import joined
from pcdata.structures import Camera, DepthFrame, Signal, register_to_color

Read = Callable[..., bytes]


class JoinedRecording(JoinedTopics):
    """The depth images of a recording, counted from 0 in the order of time, read with what belongs to each."""

    def signals_at(self, number: int) -> dict[str, Signal]:
        """Return the signals of a depth image, without reading it.

        Raises:
            PcdataError: a message is damaged, or not of its kind.
        """
        with self._log.opened() as read:
            return self._signals(read, number)

    def _signals(self, read: Read, number: int) -> dict[str, Signal]:
        found: dict[str, Signal] = {}
        time = int(self.times[number])
        for one in self.signals:
            try:
                found[one.name] = self._signal(read, one, number, time)
            except PcdataError as error:
                add_note(error, f"signal {one.name!r} at depth image {number}")
                raise
        for name, frame in self._joining.poses.items():
            assert self.frame_id is not None
            found[name] = Signal(self.pose(self.frame_id, frame, time)[None], "pose matrix", self.frame_id)
        return found

    def _signal(self, read: Read, one: SignalStream, number: int, time: int) -> Signal:
        before, after, share = self.partner(f"signal {one.name}", one.topic, number)
        message = decoded(one.topic, read(one.topic, before))
        one.check_frame(message)
        other = message if after == before else decoded(one.topic, read(one.topic, after))
        value = one.between(message, other, share)
        if isinstance(value, str):
            return Signal((value,), "text")
        signal = signal_of(self._where, one.name, one.tensor(value), (one.kind, one.frame))
        if one.frame in (None, self.frame_id, "camera"):
            return signal
        assert self.frame_id is not None
        assert one.frame is not None
        moved = signal.moved(self.pose(self.frame_id, one.frame, time)[None])
        return Signal(moved, one.kind, self.frame_id)

    def load(self, number: int, sample_id: str, provenance: Mapping[str, Any], invalid: tuple[int, ...]) -> DepthFrame:
        """Read a depth image with all that belongs to it.

        Raises:
            PcdataError: a message is damaged, or cannot be right.
        """
        with self._log.opened() as read:
            views = [self._view(read, camera, number, sample_id, provenance, invalid) for camera in self.cameras]
            signals = self._signals(read, number)
        frame = views[0]
        if len(views) > 1:
            facts = [view.provenance for view in views]
            shared = {key: value for key, value in facts[0].items() if all(one.get(key) == value for one in facts)}
            each = {key: [one[key] for one in facts] for key in ("topics", "stamp_ns")}
            times = [time for one in facts for time in one["timestamps"]]
            names = [camera.name for camera in self.cameras]
            frame = join_views(views, {**shared, **each, "timestamps": times, "cameras": names})
        for name, signal in signals.items():
            frame = frame.with_signal(name, signal.values, signal.kind, signal.frame)
        return frame

    def _view(
        self,
        read: Read,
        camera: CameraStream,
        number: int,
        sample_id: str,
        provenance: Mapping[str, Any],
        invalid: tuple[int, ...],
    ) -> DepthFrame:
        topic = camera.images.topic
        place = number if camera is self.cameras[0] else self.partner("depth", topic, number)[0]
        time = int(topic.times[place])
        where = f"{self._where}: {topic.name}, image {place}"
        numbers = depth_numbers(decoded(topic, read(topic, place)))
        is_whole = numbers.dtype == np.uint16
        depth = _in_metres(where, numbers, camera.unit if is_whole else camera.float_unit, invalid)
        recorded = camera.facts.get("recorded_metres_per_unit", camera.unit if is_whole else None)
        topics = {"depth": topic.name}
        facts = {
            **provenance,
            **({"metres_per_unit": recorded} if isinstance(recorded, float) else {}),
            **({"unit_is_recorded": True} if camera.unit_source == RECORDED else {}),
            "unit_source": camera.unit_source,
            "timestamps": [(time - int(self.times[0])) / 1e9],
            "stamp_ns": time,
        }
        colors = None
        if camera.color is not None:
            color = camera.color.topic
            partner = self.partner("color", color, number)[0]
            colors = color_pixels(decoded(color, read(color, partner)))
            topics["color"] = color.name
            facts["color_seconds_later"] = (int(color.times[partner]) - time) / 1e9
        aligned = colors is not None and camera.color_camera is None
        if aligned and colors is not None and colors.shape[:2] != depth.shape:
            raise CaptureError(f"{where}: the color image has {colors.shape[1]}x{colors.shape[0]} pixels, not its own")
        frame = DepthFrame(
            depth=torch.from_numpy(depth)[None],
            camera=self._camera(read, camera, time, (depth.shape[0], depth.shape[1])),
            colors=torch.from_numpy(colors)[None] if aligned and colors is not None else None,
            **self._others(read, camera, number),
            sample_id=sample_id,
            capture_index=number,
            provenance={**facts, "topics": topics},
        )
        if self.frame_id is not None:
            pose = self._camera_pose(read, camera, number, time)
            frame = replace(frame, world_from_camera=pose[None], frame_id=self.frame_id)
        if colors is None or camera.color_camera is None or camera.color is None:
            return frame
        color_from_depth = self._color_from_depth
        if color_from_depth is None:
            color_from_depth = self.pose(camera.color.frame, camera.images.frame, time)
        return register_to_color(frame, torch.from_numpy(colors)[None], camera.color_camera, color_from_depth)

    def _others(self, read: Read, camera: CameraStream, number: int) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for role, topic in camera.others.items():
            place, _, _ = self.partner(role, topic, number)
            image = torch.from_numpy(np.array(plain_numbers(decoded(topic, read(topic, place)))))[None]
            found[role] = image.long() if role == "labels" else image > 0 if role == "mask" else image
        return found

    def _camera_pose(self, read: Read, camera: CameraStream, number: int, time: int) -> Tensor:
        assert self.frame_id is not None
        topic = self._stated_pose(camera)
        if topic is None:
            return self.pose(self.frame_id, camera.images.frame, time)
        place, _, _ = self.partner("pose", topic, number)
        values = np.asarray(decoded(topic, read(topic, place)).data, np.float64)
        if values.size != 16:
            raise CaptureError(f"{self._where}: {topic.name}: a pose has 16 numbers, this one has {values.size}")
        return torch.from_numpy(values.reshape(4, 4).copy())

    def _camera(self, read: Read, camera: CameraStream, time: int, size: tuple[int, int]) -> Camera:
        if camera.infos is None:
            assert camera.camera is not None
            if camera.camera.size != size:
                raise CaptureError(
                    f"{self._where}: {camera.images.topic.name}: an image has {size[1]}x{size[0]} pixels, the first "
                    f"has {camera.camera.size[1]}x{camera.camera.size[0]}"
                )
            return camera.camera
        place = max(0, int(joined([time], camera.infos.times, "step").before[0]))
        info = decoded(camera.infos, read(camera.infos, place))
        return camera_of(
            f"{self._where}: {camera.infos.name}",
            info,
            size,
            rectified=camera.rectified,
            is_window=camera.facts.get("is_window") is True,
        )


def _in_metres(where: str, numbers: NDArray[Any], unit: float, invalid: Sequence[int]) -> NDArray[np.float32]:
    if numbers.dtype == np.uint16:
        depth = metres_of_numbers(numbers, unit, invalid)
    else:
        depth = clean_float_depth(where, numbers, unit, invalid)
    check_plausible(where, depth, DepthUnit(unit), numbers)
    return depth
