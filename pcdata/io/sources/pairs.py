"""Images in one folder, told apart by a word in their names: ``depth_000.npy`` beside ``color_000.png``.

So lie the frames of AnyGrasp, gqcnn, D3RoMa, ClearGrasp and M2T2, and most that a script of one's own has saved.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from pcdata.contracts.lengths import check_metres_per_unit
from pcdata.errors import CaptureError, UnitError
from pcdata.files.sample_names import name_some
from pcdata.functional.depth.unit_fit import DepthEncoding, check_depth_encoding
from pcdata.io.calibration.foreign_cameras import ForeignCamera, pinhole, read_foreign_camera
from pcdata.io.images.reading import COLOR_SUFFIXES, DEPTH_SUFFIXES, image_size, read_depth, read_raw_depth
from pcdata.io.sources.disparity_unit import unit_by_disparity
from pcdata.io.sources.listed import ListedSource, Size, StoredView, stated_intrinsics, stated_unit
from pcdata.io.sources.listing import (
    LinkTargets,
    absolute,
    entries,
    has_file,
    is_folder,
    link_targets,
    visible_files,
)
from pcdata.io.sources.option_checks import check_invalid_values, check_label, check_name
from pcdata.io.sources.registry import register_layout
from pcdata.io.sources.source import check_partners
from pcdata.io.sources.stated import one_value
from pcdata.structures import Camera, Signal

_WORDS = {  # of file names, without case: the role that they tell
    "depth": "depth",
    "color": "color",
    "colour": "color",
    "rgb": "color",
    "label": "labels",
    "labels": "labels",
    "seg": "labels",
    "segmask": "labels",
    "segmentation": "labels",
    "mask": "labels",
    "disparity": "disparity",  # of a stereo camera, which tells the unit of depth
}
_SUFFIXES = {"depth": DEPTH_SUFFIXES, "color": COLOR_SUFFIXES, "labels": (".png",), "disparity": DEPTH_SUFFIXES}
_NO_NAMES = ("img", "image", "map", "raw")  # say nothing of a frame
_PICTURES = ("vis", "viz", "visualization", "preview", "colored", "colormap")  # of depth, made for viewing
_COMPARED = 4  # images whose numbers must fit one unit before it is named
_SEPARATORS = re.compile(r"[-_. ]+")


@register_layout
class _PairsSource(ListedSource):
    """Depth images and their partners in one folder, or one depth image; a frame is called after the rest of its name.

    The words: depth; color, colour, rgb; label, seg, segmentation, mask, segmask (whose values become labels, so no
    point is cut away). Disparity in pixels beside the depth, of a stereo camera whose baseline a file states, tells the
    unit. Intrinsics and a pose come from a file beside them that other programs write, see
    :func:`pcdata.io.calibration.foreign_cameras.read_foreign_camera`, or from the options. Floats are metres where
    nothing else is said.

    Where the layout is asked for by its name and no name of a file has a word, the images are depth.
    """

    kind = "pairs"
    needs = (
        "depth_NAME.npy|png|tiff|exr (or NAME_depth.png, NAME-depth-img.exr, depth.npy) in one folder, or one such "
        "file; optional color_NAME.png|jpg (or rgb) and seg_NAME.png (or label, mask); intrinsics in *.intr, "
        "*intrinsic*.txt|yaml|json, camera*.json or meta_data.json|pkl beside them, or by the option"
    )

    def __init__(
        self,
        path: Path,
        *,
        intrinsics: tuple[float, float, float, float] | None = None,
        metres_per_unit: float | None = None,
        depth_encoding: DepthEncoding | None = None,
        invalid_values: Collection[int] = (),
        background_label: int | None = None,
        frame_id: str | None = None,
        links_to: LinkTargets = (),
    ) -> None:
        """List the images and read what is said of their camera.

        Args:
            path: the folder, or the depth image.
            intrinsics: (fx, fy, cx, cy) in pixels, where no file has them.
            metres_per_unit: length of one stored depth unit; None = as a file says or disparity tells, else
                floats are metres.
            depth_encoding: order of the stored bits; None = as a file says, else "plain".
            invalid_values: stored depth values besides 0 that mean "no reading".
            background_label: the label in the files that means "no object" and becomes -1; None = keep all.
            frame_id: the frame that the pose leads to; None = as its file says.
            links_to: folders outside that links in the capture may lead to.

        Raises:
            CaptureError: there is no depth image, a frame lacks an image that others have, or a camera's file cannot be
                read.
            IntrinsicsError: no file has intrinsics and nobody states them, or both.
            UnitError: the unit is stated twice and differently. Whole numbers whose unit nobody states are an error of
                loading, which names the units that they fit.
        """
        path = absolute(path)
        where = f"{self.kind} source {path}"
        folder = path if is_folder(path) else path.parent
        allowed = [folder, *link_targets(links_to)]
        found = _by_role(folder)
        if folder != path and _told(path.name)[0] is None:
            found["depth"] = _depth_by_name([path])
        elif not found["depth"]:
            found["depth"] = _depth_by_name(visible_files(folder, _can_be_depth))
        if folder != path:
            found["depth"] = {name: file for name, file in found["depth"].items() if file == path}
            others = {role: files for role, files in found.items() if role != "depth"}
            found |= {
                role: {name: files[name] for name in found["depth"] if name in files} for role, files in others.items()
            }
            found = {role: files for role, files in found.items() if files or role == "depth"}
        if not found["depth"]:
            raise CaptureError(f"{where}: no depth image found; this layout needs {self.needs}")
        disparities = found.pop("disparity", {})
        said, read = _said_of_camera(where, folder, allowed)
        told = _of_other_sizes(where, found)
        if said.camera is not None and intrinsics is not None:
            raise CaptureError(
                f"{where}: {name_some(file.name for file in read)} and intrinsics both say them; drop one"
            )
        first, *further = list(found["depth"].values())[:_COMPARED]
        unit = one_value(folder, "metres_per_unit", said.metres_per_unit, metres_per_unit, error=UnitError)
        unit = None if unit is None else check_metres_per_unit(where, unit)
        encoding = one_value(folder, "depth_encoding", said.depth_encoding, depth_encoding, error=UnitError) or "plain"
        invalid = check_invalid_values(where, invalid_values) or said.invalid_values or ()
        camera = said.camera or partial(
            pinhole, numbers=stated_intrinsics(where, intrinsics, _unit_too(where, unit, first, further))
        )
        if unit is None and encoding == "plain":
            unit, used = _measured_unit(where, found["depth"], disparities, camera, said.baseline)
            read = [*read, *used]
        decode = partial(
            _read,
            where=where,
            others=(first, *further),
            unit=unit,
            encoding=check_depth_encoding(where, encoding),
            invalid=tuple(invalid),
        )
        facts: dict[str, Any] = {} if unit is None else {"metres_per_unit": unit}
        facts |= {} if encoding == "plain" else {"depth_encoding": encoding}
        check_partners(where, found["depth"], {role: files for role, files in found.items() if role != "depth"})
        frame = check_name(where, "frame_id", frame_id) or said.frame or "world"
        signals = {name: Signal(pose[None], "pose matrix", frame) for name, pose in (said.poses or {}).items()}
        views = {
            name: StoredView(
                files={role: files[name] for role, files in found.items()},
                read=decode,
                camera=camera,
                pose=said.pose,
                facts=facts,
                signals=signals,
            )
            for name in found["depth"]
        }
        self.background_label = check_label(where, background_label)
        super().__init__(
            path,
            views,
            frame_id=frame,
            background_label=self.background_label,
            read=read,
            unread=told,
            links_to=links_to,
        )

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        """A file with the word depth in its name, or a folder with one."""
        try:
            names = [entry.name for entry in entries(path)] if is_folder(path) else [path.name]
        except CaptureError:
            return False
        return any(_told(name)[0] == "depth" for name in names)


def _told(name: str) -> tuple[str | None, str]:
    """Return the role that the name of a file tells, and what else is in it."""
    stem, suffix = Path(name).stem, Path(name).suffix.lower()
    words = [word for word in _SEPARATORS.split(stem) if word]
    roles = [_WORDS[word.lower()] for word in words if word.lower() in _WORDS]
    if not roles or any(word.lower() in _PICTURES for word in words) or suffix not in _SUFFIXES[roles[0]]:
        return None, ""
    if len(set(roles)) > 1:
        return None, ""
    return roles[0], "-".join(word for word in words if word.lower() not in (*_WORDS, *_NO_NAMES))


def _can_be_depth(name: str) -> bool:
    """Say whether a file may be depth though no word tells: whoever asks for this layout by its name says so."""
    words = {word.lower() for word in _SEPARATORS.split(Path(name).stem)}
    return Path(name).suffix.lower() in DEPTH_SUFFIXES and words.isdisjoint([*_WORDS, *_PICTURES])


def _depth_by_name(files: Sequence[Path]) -> dict[str, Path]:
    """Return depth images by their names, which have no word that tells what they are."""
    found: dict[str, Path] = {}
    for file in files:
        name = "-".join(word for word in _SEPARATORS.split(file.stem) if word)
        if name in found:
            raise CaptureError(
                f"{file.parent}: {found[name].name} and {file.name} are both depth of {name!r}; move one"
            )
        found[name] = file
    return found


def _by_role(folder: Path) -> dict[str, dict[str, Path]]:
    """Return the images by role and name; labels may be of several frames, whose names begin with theirs."""
    found: dict[str, dict[str, Path]] = {"depth": {}}
    for file in visible_files(folder, lambda name: _told(name)[0] is not None):
        role, name = _told(file.name)
        same = found.setdefault(str(role), {})
        name = name or folder.name
        if name in same:
            raise CaptureError(f"{folder}: {same[name].name} and {file.name} are both {role} of {name!r}; move one out")
        same[name] = file
    labels = found.get("labels", {})
    if labels and not set(labels) & set(found["depth"]):
        shared = {name: labels[short] for name in found["depth"] for short in labels if name.startswith(f"{short}-")}
        found["labels"] = shared
    return {role: files for role, files in found.items() if files or role == "depth"}


def _said_of_camera(where: str, folder: Path, allowed: list[Path]) -> tuple[ForeignCamera, list[Path]]:
    """Return what the files beside the images say together, and those files."""
    said, read = ForeignCamera(), list[Path]()
    for file in entries(folder):
        if file.suffix.lower() == ".pkl" and has_file(file.with_suffix(".json")):  # the same once more
            continue
        if is_folder(file) or (found := read_foreign_camera(file, allowed)) is None:
            continue
        read.append(file)
        for name, value in found._asdict().items():
            if value is not None and getattr(said, name) is not None:
                raise CaptureError(
                    f"{where}: {name_some(one.name for one in read)} both state the {name} of the camera; move one out"
                )
        said = said._replace(**{name: value for name, value in found._asdict().items() if value is not None})
    return said, read


def _of_other_sizes(where: str, found: dict[str, dict[str, Path]]) -> list[str]:
    """Take away images on another grid than depth, such as pictures of a second camera; return what they are."""
    name, depth = next(iter(found["depth"].items()))
    size, told = image_size(where, depth), []
    for role in [role for role in found if role != "depth" and name in found[role]]:
        other = image_size(where, found[role][name])
        if other != size:
            told.append(
                f"{role}: {found[role][name].name} has {other[1]}x{other[0]} pixels, depth {size[1]}x{size[0]}: they "
                "are not of the same pixels; register one to the other"
            )
            del found[role]
    return told


def _measured_unit(
    where: str,
    depths: dict[str, Path],
    disparities: dict[str, Path],
    camera: Callable[[Size], Camera],
    baseline: float | None,
) -> tuple[float | None, list[Path]]:
    """Return the unit that disparity beside the first depth image tells, and the file; None = nothing tells one."""
    name = next((name for name in depths if name in disparities), None)
    if name is None or not baseline:
        return None, []
    focal = float(camera(image_size(where, depths[name])).intrinsics[0, 0, 0])
    unit = unit_by_disparity(where, depths[name], disparities[name], focal, baseline)
    return unit, [] if unit is None else list(disparities.values())


def _unit_too(where: str, unit: float | None, depth: Path, others: Sequence[Path]) -> str:
    """Say that the unit is missing as well, where it is."""
    try:
        if unit is None and read_raw_depth(where, depth).dtype.kind != "f":
            stated_unit(where, unit, depth, others)
    except UnitError as error:
        return f". And {str(error).partition(': ')[2]}"
    return ""


def _read(
    path: Path,
    *,
    where: str,
    others: tuple[Path, ...],
    unit: float | None,
    encoding: DepthEncoding,
    invalid: tuple[int, ...],
) -> Tensor:  # (H, W) float32 metres
    if unit is None and read_raw_depth(where, path).dtype.kind == "f":
        unit = 1.0
    return read_depth(
        path, metres_per_unit=stated_unit(where, unit, path, others), depth_encoding=encoding, invalid_values=invalid
    )
