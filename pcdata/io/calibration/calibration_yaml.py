"""The calibration file: a :class:`Calibration` to and from YAML, every fault with its place."""

from __future__ import annotations

import os
from functools import partial
from typing import Any, cast

import yaml
from torch import Tensor

from pcdata.errors import CalibrationError, CaptureError, PcdataError, locates_path
from pcdata.files.opening import read_text, replacing
from pcdata.geometry.lens_models import LENS_MODELS
from pcdata.io.calibration.pose_nodes import (
    POSE_KEYS,
    Entries,
    known_entries,
    number,
    numbers,
    pose_from_entries,
    whole,
)
from pcdata.structures import Camera
from pcdata.structures.calibration import (
    Calibration,
    Evidence,
    FramePair,
    check_camera,
    check_transform,
    faults_of_tree,
)
from pcdata.yaml_nodes import YamlDocument, yaml_text

FORMAT = "pcdata-calibration"
VERSION = 1
UNIT = "metre"

_LARGEST_SIDE = 1 << 16  # pixels
_MODELS = ("pinhole", *LENS_MODELS)  # without and with a lens


@locates_path
def read_calibration(path: str | os.PathLike[str]) -> Calibration:
    """Read a calibration file; ``docs/calibration.md`` describes every key.

    Raises:
        CaptureError: the file is missing or not text.
        CalibrationError: every fault in it, as ``file:line:column: what``.
    """
    return calibration_from_yaml(read_text("read_calibration", path), name=str(path))


@locates_path
def write_calibration(path: str | os.PathLike[str], calibration: Calibration) -> None:
    """Write the file that :func:`read_calibration` reads back exactly; equal calibrations give equal bytes.

    The file appears complete or not at all; one that is there already is replaced.

    Raises:
        CaptureError: it cannot be written.
    """
    with replacing("write_calibration", path) as temporary:
        temporary.write_text(calibration_to_yaml(calibration), encoding="utf-8")


def calibration_to_yaml(calibration: Calibration) -> str:
    """Write a calibration as text that :func:`calibration_from_yaml` reads back exactly."""
    data: dict[str, Any] = {"format": FORMAT, "version": VERSION, "unit": UNIT}
    data["cameras"] = {
        name: _camera_data(camera) | _evidence_data(calibration, name) for name, camera in calibration.cameras.items()
    }
    data["transforms"] = {
        name: {"matrix": matrix.tolist()} | _evidence_data(calibration, name)
        for name, matrix in calibration.transforms.items()
    }
    return yaml_text({key: value for key, value in data.items() if value != {}})


def calibration_from_yaml(text: str, *, name: str = "<yaml>") -> Calibration:
    """Read the text of a calibration file.

    Raises:
        CalibrationError: every fault, as ``name:line:column: what``.
    """
    document = YamlDocument(text, name, error=CalibrationError)
    top = known_entries(
        document,
        document.root,
        "a calibration",
        required=("format", "version", "unit"),
        optional=("cameras", "transforms"),
    )
    _check_header(document, top)
    evidence: dict[str, Evidence] = {}
    cameras, transforms = {}, {}
    for camera, (key, value) in _section(document, top, "cameras").items():
        cameras[camera] = _read_camera(document, camera, key, value, evidence)
    for transform, (key, value) in _section(document, top, "transforms").items():
        transforms[transform] = _read_transform(document, transform, key, value, evidence)
    document.raise_faults()
    _check_loops(document, _section(document, top, "transforms"))
    return Calibration(
        cameras=cast("dict[str, Camera]", cameras),
        transforms=cast("dict[str, Tensor]", transforms),
        evidence=evidence,
    )


def _camera_data(camera: Camera) -> dict[str, Any]:
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics[0].tolist()
    data: dict[str, Any] = {
        "model": camera.lenses[0][0] if camera.lenses else "pinhole",
        "width": camera.size[1],
        "height": camera.size[0],
    }
    data |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    return data | {"distortion": camera.lenses[0][1]} if camera.lenses else data


def _evidence_data(calibration: Calibration, name: str) -> dict[str, Any]:
    evidence = calibration.evidence.get(name)
    if evidence is None:
        return {}
    data: dict[str, Any] = {"method": evidence.method, "num_observations": evidence.num_observations}
    data |= {"residuals": dict(evidence.residuals) or None, "date": evidence.date, "notes": evidence.notes}
    return {"evidence": {key: value for key, value in data.items() if value is not None}}


def _check_header(document: YamlDocument, top: Entries) -> None:
    wanted = {"format": FORMAT, "version": VERSION, "unit": UNIT}
    remedies = {
        "format": "is this another file?",
        "version": "a file of another version needs another pcdata",
        "unit": "convert every translation to metres",
    }
    for key, value in wanted.items():
        if key in top and (found := document.plain(top[key][1])) != value:
            document.fault(top[key][1], f"{key} must be {value!r}, got {found!r}; {remedies[key]}")


def _section(document: YamlDocument, top: Entries, name: str) -> Entries:
    return document.mapping(top[name][1], name) if name in top else {}


def _read_camera(
    document: YamlDocument, name: str, key: yaml.Node, node: yaml.Node, evidence: dict[str, Evidence]
) -> Camera | None:
    what = f"camera {name!r}"
    required = ("model", "width", "height", "fx", "fy", "cx", "cy")
    entries = known_entries(document, node, what, required=required, optional=("distortion", "evidence"))
    _read_evidence(document, name, entries, evidence)
    pixels = {
        side: whole(document, entries[side][1], f"{what}: {side}", at_most=_LARGEST_SIDE)
        for side in ("width", "height")
        if side in entries
    }
    pinhole = {
        value: number(document, entries[value][1], f"{what}: {value}")
        for value in ("fx", "fy", "cx", "cy")
        if value in entries
    }
    distortion, lens = None, _read_model(document, what, entries)
    if "distortion" in entries:
        counts = LENS_MODELS[lens][1] if lens in LENS_MODELS else LENS_MODELS["opencv"][1]
        distortion = numbers(document, entries["distortion"][1], f"{what}: distortion", counts)
    if len(pixels) + len(pinhole) < 6 or None in pixels.values() or None in pinhole.values():
        return None
    size = (cast(int, pixels["height"]), cast(int, pixels["width"]))
    try:
        camera = Camera.pinhole(**cast("dict[str, float]", pinhole), size=size, distortion=distortion, lens=lens)
        check_camera(name, camera)
    except (CaptureError, CalibrationError) as error:
        document.fault(key, f"{what}: {error}")
        return None
    return camera


def _read_model(document: YamlDocument, what: str, entries: Entries) -> str | None:
    """Return the model of the lens, None where there is none."""
    if "model" not in entries:
        return None
    node = entries["model"][1]
    model = document.plain(node)
    if model not in _MODELS:
        document.fault(node, f"{what}: model must be one of {', '.join(_MODELS)}, got {model!r}")
    elif (model != "pinhole") != ("distortion" in entries):
        document.fault(node, f"{what}: model pinhole has no distortion, every other model has (see Camera.pinhole)")
    elif model != "pinhole":
        return str(model)
    return None


def _read_transform(
    document: YamlDocument, name: str, key: yaml.Node, node: yaml.Node, evidence: dict[str, Evidence]
) -> Tensor | None:
    try:
        FramePair.parse(name)
    except PcdataError as error:
        document.fault(key, str(error))
        return None
    entries = known_entries(document, node, name, optional=(*POSE_KEYS, "evidence"))
    _read_evidence(document, name, entries, evidence)
    return pose_from_entries(document, node, entries, name, partial(check_transform, name))


def _read_evidence(document: YamlDocument, name: str, entries: Entries, evidence: dict[str, Evidence]) -> None:
    if "evidence" not in entries:
        return
    what = f"{name}: evidence"
    optional = ("num_observations", "residuals", "date", "notes")
    own = known_entries(document, entries["evidence"][1], what, required=("method",), optional=optional)
    residuals = {}
    if "residuals" in own:
        for key, (_, value) in document.mapping(own["residuals"][1], f"{what}: residuals").items():
            residuals[key] = number(document, value, f"{what}: residual {key}")
    count = None
    if "num_observations" in own:
        count = whole(document, own["num_observations"][1], f"{what}: num_observations", at_most=10**9)
    texts = {key: _text(document, own[key][1], f"{what}: {key}") for key in ("method", "date", "notes") if key in own}
    evidence[name] = Evidence(
        method=texts.get("method", ""),
        num_observations=count,
        residuals=cast("dict[str, float]", residuals),
        date=texts.get("date"),
        notes=texts.get("notes"),
    )


def _text(document: YamlDocument, node: yaml.Node, what: str) -> str:
    """Read words as they stand: 2026-01-31 is a text here, not a date."""
    if not isinstance(node, yaml.ScalarNode) or not node.value.strip():
        document.fault(node, f"{what} must be words, not empty")
        return ""
    return str(node.value)


def _check_loops(document: YamlDocument, transforms: Entries) -> None:
    for name, fault in faults_of_tree(transforms):
        document.fault(transforms[name][0], str(fault))
    document.raise_faults()
