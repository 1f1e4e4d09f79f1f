"""Which capture layout a path has, by exact signs: nothing is guessed."""

from __future__ import annotations

from pathlib import Path

from pcdata.errors import CaptureError
from pcdata.files.opening import open_input
from pcdata.files.sample_names import name_some
from pcdata.io.sources.listing import entries, is_folder
from pcdata.io.sources.registry import LAYOUTS
from pcdata.io.sources.source import Source

# Signs that other layouts may have too, where they have more: a recording that lies beside a capture is not the
# capture, and any folder may have an image with the word depth in its name.
_LESS_EXACT = ("realsense_bag", "azure_kinect", "ros", "robomimic", "maniskill", "pairs", "lerobot")

_LONGEST_START = 16  # bytes
_ANY_SIZE = 1 << 50  # of a recording only the start is read
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


def detect_layout(path: Path) -> type[Source]:
    """Return the one layout whose signs are there.

    Raises:
        CaptureError: none is, or more than one.
    """
    fitting = [layout for layout in LAYOUTS.values() if layout.recognizes(path)]
    for less_exact in _LESS_EXACT:
        if len(fitting) > 1 and is_folder(path):
            fitting = [layout for layout in fitting if layout.kind != less_exact]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        kinds = " and ".join(layout.kind for layout in fitting)
        raise CaptureError(f"open_source: {path}: looks like {kinds}; say which with kind= (--kind)")
    if path.is_file() and (fault := _fault_of_file(path)):
        raise CaptureError(f"open_source: {path}: {fault}")
    known = "\n".join(f"  {layout.kind}: {layout.needs}" for layout in LAYOUTS.values())
    raise CaptureError(
        f"open_source: {path}: no known layout; found {_contents(path)}.{_captures_inside(path)} The layouts and what "
        f"each needs:\n{known}"
    )


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
        return f"is {kind}, and one image is no capture; give the folder of images and their calibration"
    return ""


def _captures_inside(path: Path) -> str:
    """Say which entries of a folder are captures themselves, such as the folder that an archive was packed with."""
    try:
        inside = entries(path) if is_folder(path) else []
    except CaptureError:
        return ""
    found = [entry.name for entry in inside[:100] if any(layout.recognizes(entry) for layout in LAYOUTS.values())]
    return f" A capture by itself: {name_some(found)}; give its path." if found else ""


def _contents(path: Path) -> str:
    if path.is_file():
        return f"a {path.suffix or 'nameless'} file"
    try:
        found = entries(path)
    except CaptureError as error:
        return f"a folder that cannot be listed ({error})"
    return name_some(entry.name + "/" * is_folder(entry) for entry in found) or "an empty folder"
