"""The section ``model`` of a configuration: a model's preset instead of the sections depth, cloud and augment."""

from __future__ import annotations

from typing import Any

from pcdata.errors import ConfigError
from pcdata.models import Preset, preset
from pcdata.transforms.chain_reading import SECTIONS
from pcdata.yaml_nodes import Document

_NAME = "name"


def preset_of_section(document: Document, entries: dict[str, Any]) -> Preset | None:
    """Read the section, ``{name: MODEL, CHOICE: VALUE, ...}``; faults go to the document."""
    if "model" not in entries:
        return None
    key, node = entries["model"]
    values = {name: document.plain(value) for name, (_, value) in document.mapping(node, "model").items()}
    for section in SECTIONS:
        if section in entries:
            document.fault(entries[section][0], f"section {section}: the model's preset has its own steps; drop one")
    loader = document.mapping(entries["loader"][1], "loader") if "loader" in entries else {}
    for name in ("windows", "collate"):
        if name in loader:
            document.fault(loader[name][0], f"loader.{name}: the model's preset makes its own batches; leave it out")
    if _NAME not in values:
        document.fault(key, "model: needs the model's name, such as {name: dp3_sim, frame: base, crop: null}")
    if document.faults:
        return None
    try:
        return stored_preset(preset(values.pop(_NAME), **values))
    except ConfigError as error:
        document.fault(node, f"model: {error}")
        return None


def stored_preset(made: Preset) -> Preset:
    """Return the preset, if what it gives are clouds, which a build can store.

    Raises:
        ConfigError: the model takes depth images, or clouds with a point for every pixel.
    """
    is_image = made.contract.takes == "depth image"
    if is_image or made.contract.main.content == "organized":
        name = made.contract.name
        what = "depth images" if is_image else "clouds with a point for every pixel"
        raise ConfigError(
            f"{name}: takes {what}, and a build stores clouds without their pixels; load captures on the fly in Python "
            f"instead, with preset({name!r}, ...).dataset(source)"
        )
    return made
