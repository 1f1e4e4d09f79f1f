"""The flags of capture layouts and of combinators: what each is called and how its value is written."""

from __future__ import annotations

from typing import Any

from pcdata.cli.argument_types import name_and_value, numbers, positive, whole_numbers

# Here, not taken from the layouts: reading those loads torch, which a help text need not wait for. A test holds the
# table to the layouts.
LAYOUT_FLAGS: dict[str, tuple[str, dict[str, Any]]] = {  # option of a layout's class: its flag
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
            "type": whole_numbers,
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
            "type": name_and_value,
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
            "type": numbers,
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
            "type": name_and_value,
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
            "type": name_and_value,
            "metavar": "IMAGES=TOPIC",
            "help": "what describes the camera of a topic of images, where it does not lie beside it; repeatable: ros",
        },
    ),
    "cloud": ("--cloud-topic", {"metavar": "TOPIC", "help": "clouds, to be read instead of depth images: ros"}),
    "poses": (
        "--pose",
        {
            "action": "append",
            "type": name_and_value,
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
COMBINATOR_FLAGS: dict[str, tuple[str, dict[str, Any]]] = {  # combinator: the field that its flag says, and the flag
    "averaged": (
        "num_frames",
        {
            "type": positive,
            "metavar": "N",
            "help": "average every N consecutive captures of a still scene into one",
        },
    ),
    "temporal": (
        "num_frames",
        {"type": positive, "metavar": "N", "help": "filter each capture with the N - 1 before it"},
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
