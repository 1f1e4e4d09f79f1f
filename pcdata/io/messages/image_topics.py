"""The topics of a recording that hold images, and what the first message of each shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pcdata.errors import CaptureError, ConfigError, near_matches
from pcdata.io.messages.decoding import decoded, is_known, plain_type
from pcdata.io.messages.images import ImageForm, form_of
from pcdata.io.messages.log_file import Topic
from pcdata.io.messages.message_log import MessageLog
from pcdata.io.messages.transforms import plain_frame

_IMAGES = (
    "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "foxglove.RawImage", "foxglove.CompressedImage"
)  # fmt: skip
_MOST_TRIED = 3  # messages of a topic whose first ones may be damaged
_TRANSPORTS = ("compressed", "compressedDepth", "theora", "ffmpeg", "zstd")


@dataclass(frozen=True, eq=False)
class ImageTopic:
    """A topic of images, and what its first message shows."""

    topic: Topic
    form: ImageForm
    frame: str

    @property
    def base(self) -> str:
        """The name without what only says how images are packed."""
        start, _, end = self.topic.name.rpartition("/")
        return start if end in _TRANSPORTS and start else self.topic.name


def image_topics(log: MessageLog) -> dict[str, ImageTopic]:
    """Return the topics of images by name, each with what its first message shows that can be read.

    Those of which none of the first few can be read are left out; :func:`faults` says why.
    """
    looked = {topic.name: _looked_at(log, topic) for topic in _of_images(log)}
    return {name: image for name, image in looked.items() if isinstance(image, ImageTopic)}


def faults(log: MessageLog, names: Sequence[str] | None = None) -> dict[str, str]:
    """Return why images cannot be read, by topic: an unknown packing, or damage."""
    looked = {topic.name: _looked_at(log, topic) for topic in _of_images(log) if names is None or topic.name in names}
    return {name: image for name, image in looked.items() if isinstance(image, str)}


def _of_images(log: MessageLog) -> list[Topic]:
    return [one for one in log.topics.values() if plain_type(one.type) in _IMAGES and len(one) and is_known(one)]


def _looked_at(log: MessageLog, topic: Topic) -> ImageTopic | str:
    """Return what the first message shows that can be read; of none, what is wrong with the first."""
    fault = ""
    with log.opened() as read:
        for number in range(min(len(topic), _MOST_TRIED)):
            try:
                message = decoded(topic, read(topic, number))
                return ImageTopic(topic, form_of(message, topic.name), plain_frame(message.header.frame_id))
            except CaptureError as error:
                fault = fault or str(error)
    return fault


def topics_in_words(log: MessageLog, kinds: Sequence[str] | None = None) -> str:
    """Return the topics with type, number of messages and rate, one to a line."""
    shown = [one for one in log.topics.values() if kinds is None or plain_type(one.type) in kinds]
    return "".join(f"\n  {told(one)}" for one in shown) or " none"


def told(topic: Topic) -> str:
    """Return what a topic is in a few words."""
    rate = f", {topic.rate():.3g} Hz" if topic.rate() else ""
    return f"{topic.name} ({topic.type}, {len(topic)} message{'s' * (len(topic) != 1)}{rate})"


def preferred(images: Sequence[ImageTopic]) -> list[ImageTopic]:
    """Return one for each image that is there both raw and packed: the raw one, which nothing was taken from."""
    best: dict[str, ImageTopic] = {}
    for image in sorted(images, key=lambda one: (one.topic.name != one.base, one.topic.name)):
        best.setdefault(image.base, image)
    return list(best.values())


def named_image(where: str, log: MessageLog, images: Mapping[str, ImageTopic], name: str) -> ImageTopic:
    """Return the images of a topic that is named.

    Raises:
        CaptureError: the topic has no messages, or none that are images.
        ConfigError: there is no such topic.
    """
    if name in images:
        return images[name]
    if name in log.topics:
        topic = log.topics[name]
        fault = faults(log, [name]).get(name)
        why = "has no messages" if not len(topic) else f"cannot be read: {fault}" if fault else "is none of images"
        raise CaptureError(f"{where}: topic {told(topic)} {why}")
    raise ConfigError(
        f"{where}: there is no topic {name!r:.200}{near_matches(name, log.topics)}; topics of images:"
        f"{topics_in_words(log, _IMAGES)}"
    )


def pixels(image: ImageTopic) -> str:
    """Return the size of images as WIDTHxHEIGHT."""
    return f"{image.form.size[1]}x{image.form.size[0]}"


def same_pixels(one: ImageTopic, other: ImageTopic) -> bool:
    """Whether images are of one size and of one camera."""
    return one.form.size == other.form.size and one.frame == other.frame
