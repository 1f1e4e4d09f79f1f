"""What describes the camera of images: the topic that is named, the one beside them, or the only one of their frame."""

from __future__ import annotations

from collections.abc import Mapping

from pcdata.errors import ConfigError, IntrinsicsError
from pcdata.io.messages.cameras import SAY_INTRINSICS, camera_of
from pcdata.io.messages.decoding import decoded, plain_type
from pcdata.io.messages.image_topics import ImageTopic
from pcdata.io.messages.log_file import Topic
from pcdata.io.messages.message_log import MessageLog
from pcdata.io.messages.transforms import plain_frame
from pcdata.structures import Camera

_INFOS = ("sensor_msgs/msg/CameraInfo", "foxglove.CameraCalibration")


def described(
    where: str,
    log: MessageLog,
    image: ImageTopic,
    named: Mapping[str, str] | None,
    intrinsics: tuple[float, float, float, float] | None,
    *,
    is_window: bool = False,
    is_only: bool = False,
) -> tuple[Camera | None, Topic | None, bool]:
    """Return the camera of all images, or the topic that describes each, and whether its projection is theirs.

    Args:
        where: for messages.
        log: the recording.
        image: the images.
        named: the topic that describes them, by the topic of the images, where it is said.
        intrinsics: fx, fy, cx, cy in pixels, which go before any topic.
        is_window: whether images are a part of those that the camera takes.
        is_only: whether no other images need a camera, so that intrinsics can be said without their topic.

    Raises:
        ConfigError: the topic that is named describes no camera.
        CaptureError, IntrinsicsError: nothing describes them, or what does is of other images.
    """
    size = image.form.size
    if intrinsics is not None:
        fx, fy, cx, cy = intrinsics
        return Camera.pinhole(fx=fx, fy=fy, cx=cx, cy=cy, size=size), None, False
    how = f"say {how_intrinsics(image.topic.name)}" if not is_only else SAY_INTRINSICS
    topic = _info_topic(where, log, image, named, how)
    told_by = f"{where}: {topic.name}"
    with log.opened() as read:
        first, last = (decoded(topic, read(topic, place)) for place in (0, len(topic) - 1))
    rectified = "rect" in image.base.rpartition("/")[2] and any(first.d if hasattr(first, "d") else first.D)
    camera, ends = (
        camera_of(told_by, info, size, rectified=rectified, is_window=is_window, how=how) for info in (first, last)
    )
    if camera.to_dict() == ends.to_dict():
        return camera, None, rectified
    return None, topic, rectified


def _info_topic(where: str, log: MessageLog, image: ImageTopic, by_images: Mapping[str, str] | None, how: str) -> Topic:
    infos = {name: one for name, one in log.topics.items() if plain_type(one.type) in _INFOS and len(one)}
    named = (by_images or {}).get(image.topic.name)
    if named is not None:
        if named not in infos:
            raise ConfigError(f"{where}: camera_info {named!r:.200} is no topic of them; it has {', '.join(infos)}")
        return infos[named]
    beside = [
        f"{image.base.rpartition('/')[0]}/{word}" for word in ("camera_info", "calibration", "camera_calibration")
    ]
    for name in beside:
        if name in infos:
            return infos[name]
    fitting = [one for one in infos.values() if _frame_of(log, one) == image.frame and image.frame]
    if len(fitting) == 1:
        return fitting[0]
    have = f"topics that describe cameras: {', '.join(infos)}" if infos else "no topic describes a camera"
    raise IntrinsicsError(
        f"{where}: nothing describes the camera of {image.topic.name}: there is no {beside[0]}; {have}. Name it by "
        f'camera_info={{"{image.topic.name}": TOPIC}}, or {how}'
    )


def how_intrinsics(topic: str) -> str:
    """Return how the intrinsics of a topic of images are said where several topics are read."""
    said = f'intrinsics={{"{topic}": [FX, FY, CX, CY]}}'
    return f"{said} in pixels (--option '{said}')"


def _frame_of(log: MessageLog, topic: Topic) -> str:
    with log.opened() as read:
        return plain_frame(decoded(topic, read(topic, 0)).header.frame_id)
