"""What to say of a path that has no known layout: what is there, and the command that reads it, where one is known."""

from __future__ import annotations

import os
import re
import shlex
from contextlib import suppress
from pathlib import Path
from typing import Any

from pcdata.errors import CacheError, CaptureError, PcdataError
from pcdata.files.opening import open_input
from pcdata.files.sample_names import name_some
from pcdata.files.whole_folders import DATASET, EXPORT
from pcdata.io.images.reading import COLOR_SUFFIXES, DEPTH_SUFFIXES
from pcdata.io.sources.demonstration_file import opened
from pcdata.io.sources.hand_eye_names import hand_eye_folders, hand_eye_tool
from pcdata.io.sources.listing import entries, is_folder
from pcdata.io.sources.registry import LAYOUTS

_LONGEST_START = 16  # bytes
_ANY_SIZE = 1 << 50  # of a recording only the start is read
_DEEPEST, _MOST_TRIED = 3, 200  # folders in folders, and entries, that are searched for captures
_IMAGES = {
    ".png": ("a PNG image", (b"\x89PNG\r\n\x1a\n",)),
    ".jpg": ("a JPEG image", (b"\xff\xd8\xff",)),
    ".jpeg": ("a JPEG image", (b"\xff\xd8\xff",)),
    ".tif": ("a TIFF image", (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")),
    ".tiff": ("a TIFF image", (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")),
    ".exr": ("an OpenEXR image", (b"v/1\x01",)),
    ".npy": ("an array of NumPy", (b"\x93NUMPY",)),
}
# By the ending of a file: what it is called, and how such a file begins.
_FILES: dict[str, tuple[str, tuple[bytes, ...]]] = {
    **_IMAGES,
    ".mkv": ("a Matroska recording", (b"\x1a\x45\xdf\xa3",)),
    ".bag": ("a ROS 1 or RealSense bag", (b"#ROSBAG V",)),
    ".mcap": ("an MCAP recording", (b"\x89MCAP",)),
    ".db3": ("a ROS 2 bag", (b"SQLite format 3\0",)),
    ".h5": ("an HDF5 file", (b"\x89HDF\r\n\x1a\n",)),
    ".hdf5": ("an HDF5 file", (b"\x89HDF\r\n\x1a\n",)),
    ".npz": ("an archive of NumPy", (b"PK",)),
}


def unknown_layout(path: Path) -> CaptureError:
    """Return the error that tells how a path of no known layout is read; where nothing can be told, all layouts."""
    if told := _written_here(path):
        return CaptureError(f"open_source: {path}: {told}")
    if path.is_file() and (fault := _fault_of_file(path)):
        return CaptureError(f"open_source: {path}: {fault}")
    start = f"open_source: {path}: no known layout; found {_contents(path)}."
    for way in (
        _dataset_inside,
        _by_its_folder,
        _captures_inside,
        _recording_inside,
        _robot_poses,
        _without_calibration,
        _lerobot_without_facts,
        _images_alone,
    ):
        if told := way(path):
            return CaptureError(f"{start} {told}. docs/captures.md lists the layouts")
    known = "\n".join(f"  {layout.kind}: {layout.needs}" for layout in LAYOUTS.values())
    return CaptureError(f"{start} The layouts and what each needs:\n{known}")


def _written_here(path: Path) -> str:
    """Say that a path is, or is in, what a command of pcdata wrote; "" = it is not."""
    from pcdata.io.store.manifest import Manifest

    for folder in (path, *list(path.absolute().parents)[:_DEEPEST]):
        name = shlex.quote(os.fspath(folder))
        where = "is" if folder == path else f"is in {name},"
        if (folder / EXPORT).is_file():
            return (
                f"{where} an export that 'pcdata export' wrote for a model's own loader; give the captures themselves"
            )
        if not (folder / DATASET).is_file() or not Manifest.is_one(folder):
            continue
        source = ""
        with suppress(CacheError):
            source = str(Manifest.read(folder).source.get("path", ""))
        return (
            f"{where} a dataset that 'pcdata build' wrote: clouds, of which every step is done. Give the captures that "
            f"it was built from{f' ({source})' if source else ''}; what it holds is told by: pcdata inspect {name}"
        )
    return ""


def _fault_of_file(path: Path) -> str:
    """Say what is wrong with a file whose name promises something that is read here; "" = nothing is to be said."""
    kind, starts = _FILES.get(path.suffix.lower(), ("", ()))
    if not kind:
        return ""
    with open_input("open_source", path, max_bytes=_ANY_SIZE) as file:
        begins = file.read(_LONGEST_START)
    is_one = any(begins.startswith(start) for start in starts)
    if not is_one:
        shown = begins[:8].hex(" ") or "nothing, the file is empty"
        return (
            f"is called {path.suffix}, but does not begin as {kind} does (it begins with {shown}): the file is damaged "
            "or cut off, or something else was saved under this name; copy it again from where it was recorded"
        )
    if path.suffix.lower() in _IMAGES:
        told = _by_its_folder(path) or _images_alone(path) or "Give the folder of images and their calibration"
        return f"is {kind}, and one image is no capture. {told}"
    if path.suffix.lower() in (".h5", ".hdf5"):
        where = f"open_source: {path}"
        try:
            with opened(where, path):
                pass
        except CaptureError as error:
            return str(error).removeprefix(f"{where}: ")
    return ""


def _by_its_folder(path: Path) -> str:
    """Say that a file is a part of the capture around it."""
    if is_folder(path) or not _is_capture(path.parent):
        return ""
    return f"The folder that it is in is a capture: {_command(path.parent)}"


def _dataset_inside(path: Path) -> str:
    """Say where in a folder a dataset is that a build wrote."""
    from pcdata.io.store.manifest import Manifest

    for entry in _entries(path):
        if is_folder(entry) and (entry / DATASET).is_file() and Manifest.is_one(entry):
            name = shlex.quote(os.fspath(entry))
            return f"{entry.name} is a dataset that 'pcdata build' wrote: pcdata view {name}, pcdata report {name}"
    return ""


def _captures_inside(path: Path) -> str:
    """Say where in a folder the captures are, such as in the folder that an archive was packed with."""
    level, tried = [path], 0
    for _ in range(_DEEPEST):
        inside = [entry for folder in level for entry in _entries(folder)][: _MOST_TRIED - tried]
        tried += len(inside)
        found = [entry for entry in inside if _is_capture(entry)]
        if len(found) == 1:
            return f"A capture by itself is {found[0].relative_to(path).as_posix()}: {_command(found[0])}"
        if found:
            names = name_some(entry.relative_to(path).as_posix() for entry in found)
            return f"Captures by themselves are {names}: {_command(found[0])}{_for_all(path, inside, found)}"
        level = [entry for entry in inside if is_folder(entry)]
    return ""


def _recording_inside(path: Path) -> str:
    """Say what is wrong with a file in a folder that would be a recording."""
    for entry in _entries(path):
        if entry.suffix.lower() not in _IMAGES and entry.is_file() and (fault := _fault_of_file(entry)):
            return f"{entry.name}: {fault}"
    return ""


def _robot_poses(path: Path) -> str:
    """Say that these are poses of a robot, which calibrate a camera and hold no captures."""
    sets = hand_eye_folders(path)
    if not sets:
        return ""
    command = f"pcdata calib hand-eye {shlex.quote(os.fspath(sets[0]))}"
    tools = name_some({hand_eye_tool(one) for one in sets})
    return f"These are poses of a robot that calibrate a camera to it, saved by {tools}: {command}"


def _for_all(path: Path, inside: list[Path], found: list[Path]) -> str:
    """Say which pattern fits all captures in a folder, where one does and nothing else."""
    depth = len(found[0].relative_to(path).parts)
    suffixes = {"/" if is_folder(one) else one.suffix for one in found}
    if len(suffixes) > 1 or (suffixes == {"/"} and [one for one in inside if is_folder(one)] != found):
        return ""
    return f", or for all {_command(path / '/'.join(['*'] * depth), suffixes.pop())}"


def _without_calibration(path: Path) -> str:
    """Say what a plain capture lacks: it has a folder of depth, and nothing that states the camera."""
    if not any(is_folder(entry) and re.sub(r"[^a-z]", "", entry.name.lower()) == "depth" for entry in _entries(path)):
        return ""
    return f"The layout folder {_refusal('folder', path)}; then {_command(path)}"


def _lerobot_without_facts(path: Path) -> str:
    """Say that a LeRobot dataset lacks the file that says what is in it."""
    if not all((path / folder).is_dir() for folder in ("meta", "data")) or (path / "meta" / "info.json").exists():
        return ""
    if not any((path / "data").rglob("*.parquet")):
        return ""
    return "meta/ and data/ are those of a LeRobot dataset, but meta/info.json is missing: copy the dataset again"


def _images_alone(path: Path) -> str:
    """Say how images are read whose names do not tell that they are depth."""
    files = [path] if path.is_file() else [entry for entry in _entries(path) if not is_folder(entry)]
    images = [file for file in files if file.suffix.lower() in {*DEPTH_SUFFIXES, *COLOR_SUFFIXES}]
    if not images or any(is_folder(entry) for entry in _entries(path)):
        return ""
    if not any(file.suffix.lower() in DEPTH_SUFFIXES for file in images):
        return "These are pictures; depth is stored in 16-bit PNG or TIFF, EXR or npy"
    why = _refusal("pairs", path)
    if "depth image" in why:  # none at all, or a picture
        return f"By the layout pairs {why}"
    flags = " ".join(re.findall(r"\((--[a-z-]+ [^()]*)\)", why))
    return f"If the images are depth: {_command(path)} --kind pairs {flags}".rstrip()


def _refusal(kind: str, path: Path) -> str:
    """Return why a layout, were it said, would refuse the path; "" = it would not."""
    layout: Any = LAYOUTS[kind]  # each has options of its own
    try:
        source = layout(path)
        source.load(source.ids[0])
    except PcdataError as error:
        return str(error).partition(": ")[2]
    return ""


def _is_capture(path: Path) -> bool:
    return any(layout.recognizes(path) for layout in LAYOUTS.values())


def _command(path: Path, ending: str = "") -> str:
    """Return the command as it is typed; the same path and options go to every command, and to ``open_source``."""
    return f"pcdata inspect {shlex.quote(os.fspath(path) + ending)}"


def _entries(path: Path) -> list[Path]:
    try:
        return entries(path) if is_folder(path) else []
    except CaptureError:
        return []


def _contents(path: Path) -> str:
    if path.is_file():
        return f"a {path.suffix or 'nameless'} file"
    try:
        found = entries(path)
    except CaptureError as error:
        return f"a folder that cannot be listed ({error})"
    return name_some(entry.name + "/" * is_folder(entry) for entry in found) or "an empty folder"
