"""Which features of a LeRobot dataset are depth, and what of the others belongs to the camera of each.

There is no one way: besides the flag of the format itself, these are the names and shapes under which data sets on the
Hugging Face hub keep depth, intrinsics and extrinsics. What they leave open (a unit, intrinsics, in which direction a
matrix leads) is asked for.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from pcdata.errors import ConfigError, UnitError
from pcdata.functional.depth.quantized import QuantizedDepth

Feature = Mapping[str, Any]
Storage = Literal["video", "image", "array", "raw"]
Direction = Literal["camera_to_frame", "frame_to_camera"]

_NUMBERS = re.compile(r"(u?int|float)(8|16|32|64)|bool")
_PREFIX = re.compile(r"^(observation\.)?((images?|depths?|depth_ffv1)\.)?")
_WORDS = re.compile(r"(^|[._])(depth_ffv1|depth|ffv1|rgb|colou?r|images?)(?=$|[._])")
_DEPTH = re.compile(r"(^|[._/])depths?(_ffv1)?($|[._/])")
_UNITS = {
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 0.001),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 0.01),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
}
_LEAST_SIDE = 4  # pixels: a smaller array is no image
_INTRINSICS = (
    "{}_camera_intrinsics", "observation.{}_camera_intrinsics", "observation.intrinsic.{}", "observation.intrinsics.{}",
    "sensors.{}.intrinsic_cv", "{}_intrinsics", "{}_intrinsic", "{}.intrinsics", "{}.intrinsic",
)  # fmt: skip
_INTRINSICS_OF_ONE = (
    "intrinsics", "intrinsic", "camera_intrinsics", "observation.intrinsics", "observation.intrinsic",
    "observation.state.intrinsic",
)  # fmt: skip
_EXTRINSICS: dict[str, Direction | None] = {  # None = the name does not say where it leads
    "sensors.{}.extrinsic_cv": "frame_to_camera",
    "{}_camera_pose": "camera_to_frame",
    "observation.{}_camera_pose": "camera_to_frame",
    "{}_camera_extrinsics": None,
    "observation.{}_camera_extrinsics": None,
    "observation.extrinsic.{}": None,
    "observation.extrinsics.{}": None,
    "{}_extrinsics": None,
    "{}_extrinsic": None,
    "{}.extrinsics": None,
    "{}.extrinsic": None,
}
_EXTRINSICS_OF_ONE: dict[str, Direction | None] = {
    "camera_pose": "camera_to_frame",
    "observation.camera_pose": "camera_to_frame",
    "extrinsics": None,
    "extrinsic": None,
    "camera_extrinsics": None,
    "observation.extrinsics": None,
    "observation.extrinsic": None,
    "observation.state.extrinsic": None,
}


@dataclass(frozen=True)
class DepthStream:
    """The depth of one camera, and what belongs to it.

    Args:
        camera: its name.
        key: of the feature, or of what lies beside the features.
        storage: in a video, as image files in rows, as arrays in rows, or as raw numbers in a file of the episode.
        metres_per_unit: of whole numbers; None = nobody says it.
        quantized: of 12-bit codes, what they stand for.
        size: (height, width), where it is stated.
        color: the feature of the color image of the same pixels.
        intrinsics: the column.
        distortion: the column.
        lens: the model of what distortion holds; None = OpenCV's polynomial.
        is_window: whether the camera is cut from a larger image.
        extrinsics: the column.
        direction: where the extrinsics lead; None = nobody says it.
        images: keys of lossless videos of the same pixels by role: labels (one more than the label, 0 = none), mask,
            confidence.
        files: by the number of the episode, where they are no videos of a feature.
        facts: for the provenance.
    """

    camera: str
    key: str
    storage: Storage
    metres_per_unit: float | None = None
    quantized: QuantizedDepth | None = None
    size: tuple[int, int] | None = None
    color: str | None = None
    intrinsics: str | None = None
    distortion: str | None = None
    lens: str | None = None
    is_window: bool = False
    extrinsics: str | None = None
    direction: Direction | None = None
    images: Mapping[str, str] = field(default_factory=dict)
    files: Mapping[int, str] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)


def depth_streams(where: str, features: Mapping[str, Feature], lossless: Sequence[str]) -> list[DepthStream]:
    """Return the depth that features hold.

    Args:
        where: for messages.
        features: by key.
        lossless: keys of videos that are in .mkv files.

    Raises:
        UnitError: the range of 12-bit codes is none.
    """
    found = []
    for key, said in features.items():
        storage = _storage(key, said, key in lossless)
        if storage is not None:
            is_coded = storage == "video" and key not in lossless and is_flagged(said)
            quantized = quantized_of(f"{where}: {key}", _about(said)) if is_coded else None
            found.append(
                DepthStream(
                    camera=camera_of(key),
                    key=key,
                    storage=storage,
                    metres_per_unit=_unit(where, key, said),
                    quantized=quantized,
                    size=size_of(said),
                    facts=_facts_of(said) if quantized else {},
                )
            )
    return _told_apart(found)


def with_partners(stream: DepthStream, streams: int, features: Mapping[str, Feature]) -> DepthStream:
    """Return depth with what other features say of its camera."""
    names = [form.format(stream.camera) for form in _INTRINSICS]
    names += _INTRINSICS_OF_ONE if streams == 1 else ()
    directions = {form.format(stream.camera): way for form, way in _EXTRINSICS.items()}
    directions |= _EXTRINSICS_OF_ONE if streams == 1 else {}
    intrinsics = next((name for name in names if _count(features.get(name)) in (4, 9)), None)
    extrinsics = next((name for name in directions if _count(features.get(name)) in (12, 16)), None)
    return replace(
        stream,
        intrinsics=intrinsics,
        extrinsics=extrinsics,
        direction=directions[extrinsics] if extrinsics else None,
        color=_color_of(stream, features),
    )


def camera_of(key: str) -> str:
    """Return the name of the camera that a feature is of: its key without the words for what it shows."""
    name = _PREFIX.sub("", key)
    return _WORDS.sub("", name).strip("._") or "camera"


def size_of(said: Feature) -> tuple[int, int] | None:
    """Return (height, width) of a feature that is an image; None where its shape is of none."""
    shape = said.get("shape")
    sides = list(shape) if isinstance(shape, (list, tuple)) else []
    if len(sides) == 3 and sides[0] in (1, 3) and sides[2] not in (1, 3):
        sides = sides[1:]
    elif len(sides) == 3 and sides[2] in (1, 3):
        sides = sides[:2]
    return (sides[0], sides[1]) if len(sides) == 2 and min(sides) >= _LEAST_SIDE else None


def is_number(said: Feature) -> bool:
    """Whether a feature is an array of numbers in the rows."""
    return _NUMBERS.fullmatch(str(said.get("dtype"))) is not None


def _channels(said: Feature) -> int:
    shape = said.get("shape")
    sides = list(shape) if isinstance(shape, (list, tuple)) else []
    if len(sides) != 3:
        return 1
    return int(sides[0] if sides[0] in (1, 3) and sides[2] not in (1, 3) else sides[2])


def _about(said: Feature) -> dict[str, Any]:
    """Return what a feature says of its video, under the names that versions had for it."""
    parts = [said.get(name) for name in ("video_info", "info")]
    return {name: value for part in parts if isinstance(part, dict) for name, value in part.items()}


def is_flagged(said: Feature) -> bool:
    """Whether a feature is depth as the format itself says it."""
    about = _about(said)
    return about.get("is_depth_map") is True or about.get("video.is_depth_map") is True


def _storage(key: str, said: Feature, is_lossless: bool) -> Storage | None:
    dtype, is_named = str(said.get("dtype")), _DEPTH.search(key) is not None
    if dtype == "depth_video" or (dtype == "video" and is_lossless and is_named):
        return "video"
    if dtype in ("video", "image") and is_flagged(said):
        return "video" if dtype == "video" else "image"
    if not is_named or _channels(said) != 1 or size_of(said) is None:
        return None
    if dtype == "video":
        return "video"
    if dtype == "image":
        return "image"
    return "array" if is_number(said) and dtype != "bool" else None


def quantized_of(where: str, about: Mapping[str, Any]) -> QuantizedDepth:
    """Return what 12-bit codes stand for, as the info of a feature says it; what it leaves out is as by default.

    Raises:
        UnitError: it is no range.
    """
    stated = {}
    for name, ours in (("depth_min", "near"), ("depth_max", "far"), ("shift", "shift")):
        value = about.get(f"video.{name}")
        if value is not None:
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise UnitError(f"{where}: video.{name} must be metres, got {value!r:.60}")
            stated[ours] = float(value)
    is_log = about.get("video.use_log", True)
    if not isinstance(is_log, bool):
        raise UnitError(f"{where}: video.use_log must be true or false, got {is_log!r:.60}")
    try:
        return QuantizedDepth(**stated, is_log=is_log)
    except UnitError as error:
        raise UnitError(f"{where}: {error}") from error


def _facts_of(said: Feature) -> dict[str, Any]:
    about = _about(said)
    options = str(about.get("video.extra_options", ""))
    is_lossless = about.get("video.lossless") is True or "lossless=1" in options
    return {"codec": str(about.get("video.codec", "unknown"))[:40], "codec_is_lossless": is_lossless}


def facts_of_sidecar(about: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is told of the codec of depth beside the features."""
    return _facts_of({"info": dict(about)})


def _unit(where: str, key: str, said: Feature) -> float | None:
    about = _about(said)
    stated = [(name, about[name]) for name in ("depth_unit", "depth_units", "unit", "units") if about.get(name)]
    units = {_UNITS.get(str(word).lower()) for _, word in stated}
    if not stated:
        return 1.0 if str(said.get("dtype")).startswith("float") else None
    if None in units or len(units) != 1:
        raise UnitError(
            f"{where}: {key}: info says {', '.join(f'{name} {word!r:.40}' for name, word in stated)}, which is no one "
            f"unit of length that is known ({', '.join(_UNITS)}); correct it in meta/info.json"
        )
    return units.pop()


def unit_named(word: Any) -> float | None:
    """Return the metres of a unit by its name, None where it is not known."""
    return _UNITS.get(str(word).lower())


def _count(said: Feature | None) -> int:
    """Return how many numbers a feature has in a row; 0 of one that is none."""
    if said is None or not is_number(said):
        return 0
    count = 1
    for side in said.get("shape") or []:
        count *= side
    return count


def _color_of(stream: DepthStream, features: Mapping[str, Feature]) -> str | None:
    """Return the color images of the same camera and the same pixels."""
    for key, said in features.items():
        is_image = said.get("dtype") in ("video", "image") and _channels(said) == 3 and not is_flagged(said)
        if is_image and key != stream.key and camera_of(key) == stream.camera and not _DEPTH.search(key):
            return key if stream.size is None or size_of(said) == stream.size else None
    return None


def _told_apart(streams: list[DepthStream]) -> list[DepthStream]:
    """Call cameras by their keys where two would have one name."""
    names = [one.camera for one in streams]
    return [one if names.count(one.camera) == 1 else replace(one, camera=one.key) for one in streams]


def check_direction(where: str, direction: Any) -> Direction | None:
    """Return where extrinsics lead.

    Raises:
        ConfigError: it is none of the two ways.
    """
    if direction is None or direction in ("camera_to_frame", "frame_to_camera"):
        return direction
    raise ConfigError(
        f"{where}: extrinsics must be camera_to_frame (they map points of the camera into the frame) or "
        f"frame_to_camera, got {direction!r:.60}"
    )
