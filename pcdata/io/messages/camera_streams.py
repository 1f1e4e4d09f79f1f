"""The cameras of a recording: which topics hold depth, what describes them, and which color belongs to which."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from pcdata.contracts.lengths import check_metres_per_unit
from pcdata.errors import CaptureError, ConfigError, IntrinsicsError, PcdataError, UnitError, add_note
from pcdata.io.messages.camera_descriptions import described, how_intrinsics
from pcdata.io.messages.clock import Clock
from pcdata.io.messages.image_topics import (
    ImageTopic,
    faults,
    named_image,
    pixels,
    preferred,
    same_pixels,
    told,
    topics_in_words,
)
from pcdata.io.messages.images import DEPTH_ENCODINGS
from pcdata.io.messages.log_file import Topic
from pcdata.io.messages.message_log import MessageLog
from pcdata.io.messages.statement import Statement
from pcdata.structures import Camera

ROLES = ("labels", "mask", "confidence")
RECORDED = "stated in the recording"
_MILLIMETRE = 0.001  # REP 118
Pinhole = tuple[float, float, float, float]  # fx, fy, cx, cy in pixels


@dataclass(frozen=True, eq=False)
class CameraStream:
    """One depth camera: its images, how they are measured, and its color.

    Args:
        name: of the camera.
        images: the depth images.
        unit, float_unit: metres of a stored whole number, and of a float.
        unit_source: who says so.
        camera: of every depth image; None = ``infos`` describe each.
        infos: what describes the images, where it changes.
        color: images of the same pixels, or of another camera that depth is to be registered to.
        color_camera: of the color images; None = of the same pixels as the depth.
        others: images of the same pixels that the recording states, by role: labels, mask, confidence.
        poses: where the camera is, as the recording states it; None = tf tells.
        facts: what the recording states of the camera.
    """

    name: str
    images: ImageTopic
    unit: float
    float_unit: float
    unit_source: str
    camera: Camera | None
    infos: Topic | None
    rectified: bool
    color: ImageTopic | None
    color_camera: Camera | None
    others: Mapping[str, Topic]
    poses: Topic | None
    facts: Mapping[str, Any]

    @property
    def topics(self) -> list[Topic]:
        """The topics whose times count."""
        images = [self.images] if self.color is None else [self.images, self.color]
        return [*(image.topic for image in images), *([self.infos] if self.infos else []), *self.others.values()]

    def on(self, clocked: Mapping[Topic, Topic]) -> CameraStream:
        """Return the camera with other times of its topics."""
        return replace(
            self,
            images=replace(self.images, topic=clocked[self.images.topic]),
            color=None if self.color is None else replace(self.color, topic=clocked[self.color.topic]),
            infos=None if self.infos is None else clocked[self.infos],
            others={role: clocked[topic] for role, topic in self.others.items()},
        )


@dataclass(frozen=True, kw_only=True)
class Choice:
    """What is said of the topics: names of depth, of color, of what describes them."""

    depth: Sequence[str] = ()
    color: Sequence[str] | None = None  # () = none is wanted
    camera_info: Mapping[str, str] | None = None
    registered: bool = False
    color_from_depth: Tensor | None = None  # (4, 4) float64, where tf does not tell it
    metres_per_unit: float | Mapping[str, float] | None = None  # of the one camera, or by topic of images
    intrinsics: Pinhole | Mapping[str, Pinhole] | None = None
    clock: Clock | None = None


def chosen_cameras(
    where: str, log: MessageLog, images: Mapping[str, ImageTopic], said: Statement, choice: Choice
) -> list[CameraStream]:
    """Return the depth cameras that are named, else all that the recording states, else the only one there is.

    Raises:
        CaptureError: there is none, or one of several would have to be guessed.
        ConfigError: no topic is called so.
        UnitError, IntrinsicsError: what an image needs is stated nowhere.
    """
    depths = _depths(where, log, images, said, choice.depth)
    if choice.intrinsics is not None and not isinstance(choice.intrinsics, Mapping) and len(depths) > 1:
        raise ConfigError(
            f"{where}: intrinsics are of one camera, and {len(depths)} are read; say of which: "
            f"{how_intrinsics(depths[0][1].topic.name)}"
        )
    for option, given in (("intrinsics", choice.intrinsics), ("metres_per_unit", choice.metres_per_unit)):
        if isinstance(given, Mapping) and (unknown := {*given} - {*images}):
            raise ConfigError(
                f"{where}: {option}: no topic of images is called {min(unknown)!r:.200}; there are {', '.join(images)}"
            )
    found = []
    for number, (name, image) in enumerate(depths):
        try:
            found.append(_stream(where, log, images, said, choice, name, image, number, is_only=len(depths) == 1))
        except PcdataError as error:
            add_note(error, f"camera {name!r}: depth topic {image.topic.name}")
            raise
    if choice.color is None and any(one.color is None for one in found):  # all views have color, or none
        return [replace(one, color=None, color_camera=None) for one in found]
    return found


def _depths(
    where: str, log: MessageLog, images: Mapping[str, ImageTopic], said: Statement, named: Sequence[str]
) -> list[tuple[str, ImageTopic]]:
    if named:
        return [(_camera_name(name, named), named_image(where, log, images, name)) for name in named]
    depths = [image for image in images.values() if image.form.role == "depth"]
    if said.cameras:
        found = []
        for camera in said.cameras:
            fitting = preferred([image for image in depths if image.base.startswith(f"/{camera}/depth/")])
            if len(fitting) != 1:
                raise CaptureError(
                    f"{where}: it states a camera {camera!r:.100}, but {len(fitting)} topics of depth begin with "
                    f"/{camera:.100}/depth/"
                )
            found.append((camera, fitting[0]))
        return found
    fitting = preferred(depths)
    if len(fitting) == 1:
        return [(_camera_name(fitting[0].topic.name, ()), fitting[0])]
    how = "depth=TOPIC (--depth-topic TOPIC), or a list of topics for views of one frame"
    if fitting:
        raise CaptureError(
            f"{where}: holds {len(fitting)} topics of depth; say which by {how}:"
            + "".join(f"\n  {told(one.topic)}" for one in fitting)
        )
    unreadable = "".join(f"\n  {name} cannot be read: {fault}" for name, fault in faults(log).items())
    raise CaptureError(
        f"{where}: no topic holds depth images (16UC1, 32FC1, compressedDepth) that say so; name one by {how}. "
        f"Topics:{topics_in_words(log)}{unreadable}"
    )


def _camera_name(name: str, all_names: Sequence[str]) -> str:
    """Return what a depth topic's camera is called: what its name begins with, before what is said of the image."""
    words = [word for word in name.split("/") if word]
    start = next((place for place, word in enumerate(words) if "depth" in word.lower()), 1)
    short = "/".join(words[:start]) or next(iter(words), "camera")
    others = [other for other in all_names if other != name]
    return name.strip("/") if any(other.strip("/").startswith(f"{short}/") for other in others) else short


def _stream(
    where: str,
    log: MessageLog,
    images: Mapping[str, ImageTopic],
    said: Statement,
    choice: Choice,
    name: str,
    image: ImageTopic,
    number: int,
    *,
    is_only: bool,
) -> CameraStream:
    own = image.topic.name.split("/")[1] if image.topic.name.count("/") > 1 else ""
    facts = said.cameras.get(own, {})
    unit, float_unit, unit_source = _units(where, image, facts, _said_of(image, choice.metres_per_unit))
    is_window = facts.get("is_window") is True
    intrinsics = _said_of(image, choice.intrinsics)
    camera, infos, rectified = described(
        where, log, image, choice.camera_info, intrinsics, is_window=is_window, is_only=is_only
    )
    color = _color(where, log, images, choice, image, number)
    color_camera = None
    if color is not None and not same_pixels(color, image):
        if not choice.registered:
            raise CaptureError(
                f"{where}: the images of {color.topic.name} ({pixels(color)}, frame {color.frame!r}) are of other "
                f"pixels than the depth ({pixels(image)}, frame {image.frame!r}); registered=True (--registered) "
                "registers the depth to them"
            )
        intrinsics = _said_of(color, choice.intrinsics) if isinstance(choice.intrinsics, Mapping) else None
        color_camera, color_infos, _ = described(where, log, color, choice.camera_info, intrinsics)
        if color_camera is None:
            assert color_infos is not None
            raise IntrinsicsError(
                f"{where}: the color camera of {color_infos.name} changes; it cannot be registered to"
            )
    others = {role: log.topics.get(f"/{own}/{role}/image_raw") for role in ROLES if facts}
    return CameraStream(
        str(facts.get("name", name)),
        image,
        unit,
        float_unit,
        unit_source,
        camera,
        infos,
        rectified,
        color,
        color_camera,
        {role: topic for role, topic in others.items() if topic is not None and len(topic)},
        log.topics.get(f"/{own}/pose_matrix") if facts else None,
        facts,
    )


def _said_of(image: ImageTopic, given: Any) -> Any:
    return given.get(image.topic.name) if isinstance(given, Mapping) else given


def _units(where: str, image: ImageTopic, said: Mapping[str, Any], given: float | None) -> tuple[float, float, str]:
    """Return metres of a stored whole number and of a float, and who says so."""
    stated, are_floats = said.get("metres_per_unit"), image.form.encoding == "32FC1"
    if given is not None:
        unit = check_metres_per_unit(where, given)
        return unit, unit if are_floats else 1.0, "stated by metres_per_unit"
    if stated is not None:
        return check_metres_per_unit(f"{where}: topic /pcdata", stated), 1.0, RECORDED
    if are_floats:
        return _MILLIMETRE, 1.0, "REP 118: depth of floats is in metres"
    if image.form.encoding == "16UC1":
        return _MILLIMETRE, 1.0, "REP 118: 16-bit depth is in millimetres"
    if image.form.encoding not in DEPTH_ENCODINGS:
        raise CaptureError(
            f"{where}: images of {image.topic.name} are encoded as {image.form.encoding!r:.60}, which is not read as "
            f"depth; depth is encoded as {', '.join(DEPTH_ENCODINGS)}; name another topic, or convert the images"
        )
    raise UnitError(
        f"{where}: images of {image.topic.name} are encoded as {image.form.encoding!r}, which says nothing of a unit "
        "(16UC1 would be millimetres); say metres_per_unit=0.001 (--metres-per-unit) if they are millimetres"
    )


# -- color -------------------------------------------------------------------------------------------------------------


def _color(
    where: str, log: MessageLog, images: Mapping[str, ImageTopic], choice: Choice, depth: ImageTopic, number: int
) -> ImageTopic | None:
    if choice.color is not None:
        if not choice.color:
            return None
        if len(choice.color) not in (1, len(choice.depth) or 1):
            raise ConfigError(f"{where}: color names {len(choice.color)} topics for {len(choice.depth)} of depth")
        return named_image(where, log, images, choice.color[number % len(choice.color)])
    colors = preferred([image for image in images.values() if image.form.role == "color"])
    same = [image for image in colors if same_pixels(image, depth)]
    fitting = same or (colors if choice.registered else [])
    if len(fitting) > 1:
        fitting = _beside(fitting, depth)
    if len(fitting) == 1:
        return fitting[0]
    if choice.registered or same:
        raise CaptureError(
            f"{where}: {len(fitting)} topics of color may belong to {depth.topic.name}; say which by color=TOPIC "
            "(--color-topic TOPIC), or color=[] for none:" + "".join(f"\n  {told(one.topic)}" for one in fitting)
        )
    return None


def _beside(images: Sequence[ImageTopic], depth: ImageTopic) -> list[ImageTopic]:
    """Return those whose names begin with the most words that the depth's name begins with."""

    def shared(image: ImageTopic) -> int:
        pairs: Callable[[str], list[str]] = lambda name: name.strip("/").split("/")  # noqa: E731
        count = 0
        for one, other in zip(pairs(image.base), pairs(depth.base)):
            if one != other:
                break
            count += 1
        return count

    most = max(map(shared, images))
    return [image for image in images if shared(image) == most]
