"""What inspect tells of folders of robot poses, which hold no captures: what is there, what is missing, the command."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pcdata.calibration.robot_poses import read_hand_eye_set, read_robot_poses
from pcdata.errors import PcdataError
from pcdata.io.sources.hand_eye_names import MOVEIT, hand_eye_folders, hand_eye_tool
from pcdata.io.sources.listing import absolute
from pcdata.report.capture_facts import SCHEMA
from pcdata.report.plain_table import text_table


def hand_eye_facts(path: str) -> dict[str, Any] | None:
    """Return what the sets in a folder, or a file, hold, as JSON can hold it; None = there is none."""
    place = absolute(path)
    sets = hand_eye_folders(place)
    if not sets:
        return None
    return {"schema": SCHEMA, "name": place.name, "hand_eye": [_of_set(one) for one in sets]}


def _of_set(folder: Path) -> dict[str, Any]:
    facts: dict[str, Any] = {"name": folder.name, "tool": hand_eye_tool(folder)}
    facts["next"] = f"pcdata calib hand-eye {shlex.quote(os.fspath(folder))}"
    try:
        if facts["tool"] == MOVEIT:
            return facts | {"poses": len(read_robot_poses(folder).names), "targets": "with each pose"}
        found = read_hand_eye_set(folder)
        missing = found.missing
    except PcdataError as error:
        return facts | {"refused": str(error)}
    facts |= {"poses": len(found.base_from_gripper), "camera": found.camera_said, "missing": missing}
    facts["board"] = found.board_said if found.board is None else f"{found.board} ({found.board_said})"
    if found.camera_from_target:
        facts["targets"] = f"located for {len(found.camera_from_target)} poses"
    return facts


def hand_eye_text(facts: Mapping[str, Any]) -> str:
    """Tell what :func:`hand_eye_facts` found."""
    return "\n\n".join(_text_of_set(one) for one in facts["hand_eye"])


def _text_of_set(facts: Mapping[str, Any]) -> str:
    rows = [["kind", f"poses of a robot that calibrate a camera to it, saved by {facts['tool']}; no captures"]]
    rows += [[key, str(facts[key])] for key in ("poses", "targets", "camera", "board", "refused") if key in facts]
    if missing := facts.get("missing"):
        rows.append(["images", f"missing: {', '.join(missing[:20])}{' and more' * (len(missing) > 20)}"])
    elif "missing" in facts:
        rows.append(["images", "all there"])
    return text_table(["hand-eye set", facts["name"]], [*rows, ["next", facts["next"]]])
