"""Which folder of a plain capture holds what; one that looks like a part of it is read or refused."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path, PurePath
from shlex import quote
from typing import Any

from pcdata.errors import CaptureError, ConfigError, near_matches
from pcdata.io.images.reading import COLOR_SUFFIXES, DEPTH_SUFFIXES
from pcdata.io.sources.listing import check_links, entries, has_folder, is_folder

ROLES = {  # role: folder, suffixes
    "depth": ("depth", DEPTH_SUFFIXES),
    "color": ("color", COLOR_SUFFIXES),
    "labels": ("labels", (".png",)),
    "mask": ("masks", (".png",)),
    "confidence": ("confidence", (".png",)),
    "pose": ("poses", (".txt", ".npy")),
    "intrinsics": ("intrinsics", (".json",)),
    "signals": ("signals", (".json",)),
}
# What other exporters call the same, without case, plural s and separators.
_OTHER_NAMES = {
    "depth": ("depth", "depthimage", "depthmap", "dep"),
    "color": ("color", "colour", "rgb", "image", "img", "colorimage", "colourimage", "rgbimage"),
    "labels": ("label", "segmentation", "seg", "semantic", "instance", "labelimage"),
    "mask": ("mask", "workspacemask", "objectmask"),
    "confidence": ("confidence", "conf", "confidencemap"),
    "pose": ("pose", "camerapose", "campose", "extrinsic", "trajectory"),
    "intrinsics": ("intrinsic", "camera", "caminfo"),
    "signals": ("signal", "robotstate", "action"),
}


def role_folders(path: Path, folders: Mapping[str, str | None] | None) -> dict[str, Path]:
    """Return the folder of every role that a capture has.

    Args:
        path: the folder of the capture.
        folders: role -> name of its folder in ``path``; None = that role is left out. A role that is not named is
            looked for under its own name.

    Raises:
        ConfigError: no such role, a folder outside the capture, or no depth.
        CaptureError: a named folder is missing, or one looks like a role that is neither read nor left out.
    """
    where = f"folder source {path}"
    named = {} if folders is None else check_folders(where, folders)
    found = {}
    for role, (usual, _) in ROLES.items():
        name = named.get(role, usual)
        if name is not None and has_folder(path / name):
            found[role] = path / name
        elif named.get(role) is not None:
            raise CaptureError(f"{where}: has no folder {name!r} for {role}; correct folders ({role}={name})")
    _check_lookalikes(where, path, found, named)
    return found


def check_folders(where: str, named: Any) -> dict[str, str | None]:
    """Return names of folders by role; they must be roles, and folders within a capture.

    Raises:
        ConfigError: no such role, a folder outside the capture, or no depth.
    """
    if not isinstance(named, Mapping):
        raise ConfigError(f"{where}: folders must map roles to names, such as {{'pose': 'pose'}}, got {named!r:.200}")
    for role, name in named.items():
        if role not in ROLES:
            raise ConfigError(
                f"{where}: folders: no role {role!r}{near_matches(str(role), ROLES)}; known: {', '.join(ROLES)}"
            )
        if name is None and role != "depth":
            continue
        if not is_within(name):
            raise ConfigError(f"{where}: folders: {role} must be the name of a folder in the capture, got {name!r}")
    return dict(named)


def _check_lookalikes(where: str, path: Path, found: Mapping[str, Path], named: Mapping[str, str | None]) -> None:
    alike: list[str] = []
    ways: list[tuple[str, str]] = []
    for entry in entries(path):
        role = next((role for role, names in _OTHER_NAMES.items() if _plain(entry.name) in names), None)
        if role is None or role in found or role in named or role in dict(ways):
            continue
        check_links([entry])
        if not is_folder(entry):
            continue
        meaning = {"pose": " (4x4 each, world from camera)", "signals": " (docs/signals.md)"}.get(role, "")
        alike.append(f"{entry.name}/ looks like {role}, which is read from {ROLES[role][0]}/{meaning}")
        ways.append((role, entry.name))
    if alike:
        flags = " ".join(f"--folder {quote(f'{role}={name}')}" for role, name in ways)
        one = len(ways) == 1
        optional = [role for role, _ in ways if role != "depth"]
        out = ""
        if optional:
            values = ", ".join(f"{role!r}: None" for role in optional)
            out = f"; to leave {optional[0] if one else 'them'} out: "
            out += f"{' '.join(f'--folder {role}=' for role in optional)} (in Python {values})"
        raise CaptureError(
            f"{where}: {'; '.join(alike)}; rename {'it' if one else 'them'}, or say "
            f"{flags} (in Python folders={dict(ways)!r}){out}"
        )


def _plain(name: str) -> str:
    return re.sub(r"[-_ .]", "", name.lower()).removesuffix("s")


def is_within(name: Any) -> bool:
    """Say whether this is the name of something within a folder."""
    return (
        isinstance(name, str) and bool(name) and not PurePath(name).is_absolute() and ".." not in PurePath(name).parts
    )
