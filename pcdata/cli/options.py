"""Options that several commands share, and what they open."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from pcdata.cli.known_names import KINDS

# Here, not taken from the layouts: reading those loads torch, which a help text need not wait for. A test holds the
# table to the layouts.
_FLAGS: dict[str, tuple[str, dict[str, Any]]] = {  # option of a layout's class: its flag
    "metres_per_unit": (
        "--metres-per-unit",
        {"type": float, "metavar": "M", "help": "length of one stored unit of depth or coordinates"},
    ),
    "depth_encoding": (
        "--depth-encoding",
        {
            "choices": ("plain", "rotated", "swapped"),
            "help": "order of the stored bits: rotated to the left by three (SUN3D), or bytes swapped (default: plain)",
        },
    ),
    "invalid_values": (
        "--invalid-values",
        {
            "type": lambda text: [int(number) for number in text.split(",")],
            "metavar": "N,...",
            "help": "stored depths besides 0 that mean no reading, such as 65535",
        },
    ),
    "background_label": ("--background-label", {"type": int, "metavar": "ID", "help": "label that means no object"}),
    "calibration": (
        "--calibration",
        {"metavar": "FILE", "help": "calibration file: its intrinsics, and with --frame its poses, are used"},
    ),
    "camera": (
        "--camera",
        {
            "metavar": "NAME",
            "help": "which camera, of the calibration or of a bop, rlbench, robomimic or maniskill recording "
            "(default: the only one, or all)",
        },
    ),
    "frame_id": ("--frame", {"metavar": "NAME", "help": "frame that the poses lead to, such as base"}),
    "folders": (
        "--folder",
        {
            "action": "append",
            "type": lambda text: name_and_value(text),
            "metavar": "ROLE=NAME",
            "help": "name of the folder of a role (depth, color, labels, mask, confidence, pose, intrinsics, signals); "
            "ROLE= leaves it out",
        },
    ),
    "intrinsics": (
        "--intrinsics",
        {
            "type": float,
            "nargs": 4,
            "metavar": ("FX", "FY", "CX", "CY"),
            "help": "pixels, where no file has them: seven_scenes, tum, nyu_raw, pairs, robomimic, ros",
        },
    ),
    "registered": (
        "--registered",
        {
            "action": "store_const",
            "const": True,
            "help": "depth as the color camera sees it: realsense_bag, azure_kinect, ros, scannet; apc stores it so",
        },
    ),
    "color_from_depth": (
        "--color-from-depth",
        {
            "type": lambda text: [float(number) for number in text.replace(",", " ").split()],
            "metavar": "'M00 M01 ... M33'",
            "help": "depth-to-color matrix, 16 numbers row by row, where no file has it: apc, ros",
        },
    ),
    "labels_from": (
        "--labels-from",
        {"metavar": "COLUMN", "help": "column of cloud files that holds the labels; of bop, object or instance"},
    ),
    "signals": (
        "--signal",
        {
            "action": "append",
            "type": lambda text: name_and_value(text),
            "metavar": "NAME=KIND",
            "help": "kind of a recorded stream, such as 'eef=pose xyz_quat_xyzw in base' or joints=invariant; NAME= "
            "leaves it out; repeatable: robomimic, maniskill, lerobot, ros",
        },
    ),
    "depth_values": (
        "--depth-values",
        {"choices": ("z", "z_buffer"), "help": "metres, or a renderer's buffer between near and far: robomimic"},
    ),
    "near": ("--near", {"type": float, "metavar": "M", "help": "plane where a buffer is 0: robomimic"}),
    "far": ("--far", {"type": float, "metavar": "M", "help": "plane where a buffer is 1: robomimic"}),
    "rows": (
        "--rows",
        {"choices": ("top_first", "bottom_first"), "help": "which row of an image is stored first: robomimic"},
    ),
    "extrinsics": (
        "--extrinsics",
        {
            "choices": ("camera_to_frame", "frame_to_camera"),
            "help": "where matrices called extrinsics lead, which their name does not say: lerobot",
        },
    ),
    "clouds": (
        "--clouds",
        {"action": "store_const", "const": True, "help": "read point clouds where there is depth too: lerobot"},
    ),
    "depth": ("--depth-topic", {"action": "append", "metavar": "TOPIC", "help": "depth images; repeatable: ros"}),
    "color": ("--color-topic", {"action": "append", "metavar": "TOPIC", "help": "color, for each depth or all: ros"}),
    "camera_info": (
        "--camera-info",
        {
            "action": "append",
            "type": lambda text: name_and_value(text),
            "metavar": "IMAGES=TOPIC",
            "help": "what describes the camera of a topic of images, where it does not lie beside it; repeatable: ros",
        },
    ),
    "cloud": ("--cloud-topic", {"metavar": "TOPIC", "help": "clouds, to be read instead of depth images: ros"}),
    "poses": (
        "--pose",
        {
            "action": "append",
            "type": lambda text: name_and_value(text),
            "metavar": "NAME=FRAME",
            "help": "signal NAME: the pose of this frame of tf in that of --frame; repeatable: ros",
        },
    ),
    "clock": (
        "--clock",
        {"choices": ("header", "recorded"), "help": "whose times streams are joined by (default: header): ros"},
    ),
    "max_gap": (
        "--max-gap",
        {"type": float, "metavar": "SECONDS", "help": "to messages that are interpolated: ros (default 0.1)"},
    ),
    "links_to": (
        "--links-to",
        {"action": "append", "metavar": "DIR", "help": "folder outside that links may lead to, such as a DVC cache"},
    ),
    "max_time_apart": (
        "--max-time-apart",
        {
            "type": float,
            "metavar": "SECONDS",
            "help": "between images: realsense_bag, azure_kinect, ros (default 0.034), tum (0.02), sun3d (0.05)",
        },
    ),
}
_COMBINED: dict[str, tuple[str, dict[str, Any]]] = {  # combinator: the field that its flag says, and the flag
    "averaged": (
        "num_frames",
        {
            "type": lambda text: positive(text),
            "metavar": "N",
            "help": "average every N consecutive captures of a still scene into one",
        },
    ),
    "temporal": (
        "num_frames",
        {"type": lambda text: positive(text), "metavar": "N", "help": "filter each capture with the N - 1 before it"},
    ),
    "convention": (
        "axes",
        {
            "choices": ("opencv", "opengl", "coppeliasim", "body"),
            "help": "axes of the cameras that the poses are of, where they are not OpenCV's; its other fields (poses, "
            "depth, near, far, rows, principal_point) are --option convention.FIELD=VALUE",
        },
    ),
    "posed": (
        "file",
        {
            "metavar": "FILE",
            "help": "where the cameras stand, in place of what the captures say: a .json of extrinsics by episode and "
            "serial, as DROID's are published, or a calibration file; its other fields (frame_id, episode, camera) are "
            "--option posed.FIELD=VALUE",
        },
    ),
}
_NO_OPTIONS = {  # of opening captures, not of their layout
    "path": "the path itself",
    "kind": "--kind",
    "only": "--only",
    "limit": "--limit",
    "skip": "--skip",
    "skip_refused": "--skip-refused",
}
RIG_OPTIONS = ("metres_per_unit", "depth_encoding", "invalid_values", "background_label", "folders", "links_to")


def add_capture_options(command: argparse.ArgumentParser, *, can_skip_refused: bool = True) -> None:
    """Add what says how captures are to be read, and which are left out."""
    command.add_argument(
        "--kind",
        metavar="LAYOUT",
        help=f"capture layout, where it cannot be told from the files: {', '.join(KINDS)}",
    )
    add_layout_options(command, tuple(_FLAGS))
    add_combinator_options(command)
    add_skip_options(command, can_skip_refused=can_skip_refused)
    add_import_option(command)


def add_import_option(command: argparse.ArgumentParser) -> None:
    """Add what runs a file of the user's own before the command."""
    command.add_argument(
        "--import",
        dest="imports",
        action="append",
        default=[],
        metavar="FILE.py",
        help="run this Python file first: transforms, layouts and combinators of your own; repeatable",
    )


def add_layout_options(command: argparse.ArgumentParser, names: tuple[str, ...]) -> None:
    """Add the flags of some options of the layouts."""
    for name in names:
        flag, settings = _FLAGS[name]
        command.add_argument(flag, **settings)


def add_combinator_options(command: argparse.ArgumentParser) -> None:
    """Add what says how captures are combined, and any option by its name."""
    command.add_argument(
        "--option",
        action="append",
        default=[],
        type=name_and_value,
        metavar="NAME=VALUE",
        help="any option of the layout by its name in Python, or a field of a combinator, such as "
        "averaged.max_jump=0.05; repeatable",
    )
    for name, (_, described) in _COMBINED.items():
        command.add_argument(f"--{name}", **described)


def add_skip_options(command: argparse.ArgumentParser, *, can_skip_refused: bool = True) -> None:
    """Add what leaves captures out."""
    command.add_argument(
        "--only", action="append", metavar="PATTERN", help="keep captures whose ids fit, such as 'left_*'; repeatable"
    )
    command.add_argument("--skip", action="append", metavar="ID", help="leave this capture out; repeatable")
    command.add_argument("--skip-file", metavar="FILE", help="leave out the captures listed in FILE, one id on a line")
    if can_skip_refused:
        command.add_argument(
            "--skip-refused",
            action="store_const",
            const=True,
            help="leave out captures that cannot be read or processed, and say which and why (default: stop at one)",
        )


def given_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the options of a layout and the combinators that the command line states, by their names in Python.

    Raises:
        ConfigError: one is stated twice.
    """
    from pcdata.errors import ConfigError

    given: dict[str, Any] = {}
    for name, (flag, _) in _FLAGS.items():
        value = getattr(arguments, attribute_of(flag), None)
        if value is not None:
            given[name] = value
    if "folders" in given:
        given["folders"] = {role: folder or None for role, folder in given["folders"]}
    given |= {name: dict(given[name]) for name in ("camera_info", "poses") if name in given}
    if "signals" in given:
        given["signals"] = {name: _stated_kind(said) for name, said in given["signals"]}
    for name, (field, _) in _COMBINED.items():
        if (value := getattr(arguments, name, None)) is not None:
            given[name] = value if field == "num_frames" else {field: value}
    for name, text in getattr(arguments, "option", []):
        combinator, dot, inner = name.partition(".")
        if dot:
            fields = given.get(combinator, {})
            fields = dict(fields) if isinstance(fields, dict) else {"num_frames": fields}
            if inner in fields:
                raise ConfigError(f"--option {name}: this field is given twice; give it once")
            given[combinator] = {**fields, inner: value_of(text)}
            continue
        if name in _NO_OPTIONS:
            raise ConfigError(f"--option {name}: is no option of a layout; say it with {_NO_OPTIONS[name]}")
        if name in given:
            raise ConfigError(f"--option {name}: this option is given twice; give it once")
        given[name] = value_of(text)
    return given


def _stated_kind(text: str) -> dict[str, str] | None:
    """Read ``KIND in FRAME`` or ``KIND``; nothing = the stream is left out."""
    kind, mark, frame = (part.strip() for part in text.rpartition(" in "))
    return ({"kind": kind, "frame": frame} if mark else {"kind": frame}) if text.strip() else None


def given_flags(arguments: argparse.Namespace, *others: str) -> list[str]:
    """Return the flags about captures, and those of ``others``, that the command line states."""
    layout = [flag for flag, _ in _FLAGS.values()]
    combined = [f"--{name}" for name in _COMBINED]
    flags = ["--kind", *layout, *combined, "--option", "--only", "--skip", "--skip-file", "--skip-refused"]
    return [flag for flag in (*flags, *others) if getattr(arguments, attribute_of(flag), None)]


def said_again(arguments: argparse.Namespace, *without: str) -> list[str]:
    """Return the words that followed the command: path and options, but for some flags with a value."""
    kept: list[str] = []
    words = iter(arguments.words)
    for word in words:
        if word in without:
            next(words, None)
        elif word != "--debug" and not word.startswith(tuple(f"{flag}=" for flag in without)):
            kept.append(word)
    return kept


def skip_list(arguments: argparse.Namespace) -> list[str]:
    """Return the ids that the command line leaves out."""
    from pcdata.io.sources.open_source import read_skip_file

    listed = list(arguments.skip or [])
    return listed + (read_skip_file(arguments.skip_file) if arguments.skip_file else [])


def open_captures(path: str, arguments: argparse.Namespace, limit: int | None = None) -> Any:
    """Open the captures at a path as the options say; captures that are left out are told on stderr."""
    from pcdata.io import open_source

    source = open_source(
        path,
        kind=arguments.kind,
        only=arguments.only or (),
        limit=limit,
        skip=skip_list(arguments),
        skip_refused=bool(getattr(arguments, "skip_refused", False)),
        **given_options(arguments),
    )
    tell_skipped(source.skipped)
    return source


def tell_skipped(skipped: dict[str, str]) -> None:
    """Say on stderr how many captures were left out, and which and why for the first."""
    for sample_id, reason in list(skipped.items())[:20]:
        print(f"left out {sample_id}: {reason}", file=sys.stderr)
    if len(skipped) > 20:
        print(f"left out {len(skipped)} captures in all", file=sys.stderr)


def attribute_of(flag: str) -> str:
    """Return the attribute that argparse keeps a flag in."""
    return flag.removeprefix("--").replace("-", "_")


def name_and_value(text: str) -> tuple[str, str]:
    """Split NAME=VALUE."""
    name, sign, value = text.partition("=")
    if not sign or not name:
        raise argparse.ArgumentTypeError(f"must be NAME=VALUE, got {text!r}")
    return name, value


def value_of(text: str) -> Any:
    """Read numbers, boxes and lists as Python writes them, true, false and none; anything else is a text."""
    import ast

    words = {"true": True, "false": False, "null": None, "none": None}
    try:
        return words[text.lower()] if text.lower() in words else ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return text


def positive(text: str) -> int:
    """Parse a whole number of at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1, got {text!r}")
    return int(text)
