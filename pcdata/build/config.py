"""The build configuration: pipeline sections, and how the result is stored and loaded."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from annotated_types import Ge
from pydantic import BaseModel, ConfigDict, ValidationError

from pcdata.build.model_section import preset_of_section, with_model
from pcdata.build.source_section import SourceSettings, source_settings
from pcdata.errors import ConfigError, locates_path, near_matches
from pcdata.io.store.manifest import FILE_NAME, Manifest
from pcdata.io.store.stores import COMPRESSIONS, Compression, Format
from pcdata.models import Preset
from pcdata.transforms.config import read_config
from pcdata.transforms.pipeline import SECTIONS, Pipeline, pipeline_from_document
from pcdata.transforms.sensor_words import SENSOR
from pcdata.yaml_nodes import YamlDocument, node_at, yaml_text

Collate = Literal["packed", "padded", "fixed"]


class Output(BaseModel):
    """How clouds are stored."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Format = "hdf5"
    compression: Compression = "none"  # lzf (hdf5) or gzip; reads are 2-4 times faster without
    keep_raw: bool = False  # also deliver depth, colour and calibration beside the clouds


class Loader(BaseModel):
    """What the loading script written into the dataset does."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    batch_size: Annotated[int, Ge(1)] = 8
    num_workers: Annotated[int, Ge(0)] = 2
    collate: Collate = "packed"
    seed: int = 0


@dataclass(frozen=True)
class BuildConfig:
    """A parsed configuration file; without one, everything at its default."""

    pipeline: Pipeline = field(default_factory=Pipeline)
    output: Output = field(default_factory=Output)
    loader: Loader = field(default_factory=Loader)
    source: SourceSettings = field(default_factory=SourceSettings)
    model: Preset | None = None  # whose preset the pipeline is

    def for_model(self, made: Preset) -> BuildConfig:
        """Return this configuration, which has no steps, with those of a model's preset.

        Raises:
            ConfigError: it has steps or a model already, or the model takes no clouds that a build stores.
        """
        return with_model(self, made)

    def stored_as(self, format: Format) -> BuildConfig:
        """Return this configuration with another format of storage.

        Raises:
            ConfigError: the format does not know the compression.
        """
        output = self.output.model_copy(update={"format": format})
        if output.compression not in COMPRESSIONS[format]:
            raise ConfigError(
                f"format {format} knows the compression {', '.join(COMPRESSIONS[format])}, not {output.compression}"
            )
        return replace(self, output=output)


_SETTINGS: dict[str, type[BaseModel]] = {"output": Output, "loader": Loader}


@locates_path
def load_config(path: str | Path) -> BuildConfig:
    """Read a YAML file; its sections source, sensor, depth, cloud, augment, model, output and loader are optional.

    The folder of a built dataset stands for the configuration that builds it again: its steps, its storage and how its
    captures were read, without their place.

    ``source`` says where the captures are, how they are read and which are left out; paths in it start from the folder
    of the file.

    ``model`` is ``{name: MODEL, CHOICE: VALUE, ...}``: the steps are those of the model's preset.

    ``sensor`` is a name that ``pcdata profiles`` lists, or ``{name: ..., depth: metres}``: what the steps' values
    ``sensor`` are computed from.

    Raises:
        ConfigError: every fault, as ``file:line:column: what``.
        CacheError: the dataset's ``dataset.json`` is damaged.
    """
    if (Path(path) / FILE_NAME).is_file():
        return _config_of_dataset(Path(path))
    return config_from_yaml(read_config(path), name=str(path), folder=Path(path).parent)


def config_from_yaml(text: str, *, name: str = "<yaml>", folder: Path | None = None) -> BuildConfig:
    """Parse the text of a configuration; see :func:`load_config`. Relative paths in it start from ``folder``."""
    document = YamlDocument(text, name)
    entries = document.mapping(document.root, "a configuration")
    known = ["source", SENSOR, *SECTIONS, "model", *_SETTINGS]
    for section, (key, _) in entries.items():
        if section not in known:
            document.fault(key, f"unknown section {section!r}{near_matches(section, known) or f'; known: {known}'}")
    settings = {
        section: _settings(document, model, entries[section][1] if section in entries else None)
        for section, model in _SETTINGS.items()
    }
    output = settings["output"]
    if output is not None and output.compression not in COMPRESSIONS[output.format]:
        known_here = ", ".join(COMPRESSIONS[output.format])
        document.fault(
            node_at(entries["output"][1], ["compression"]),
            f"output.compression: format {output.format} knows {known_here}, not {output.compression}",
        )
    source = source_settings(document, entries["source"][1] if "source" in entries else None, folder)
    made = preset_of_section(document, entries)
    config = BuildConfig(pipeline_from_document(document, entries), settings["output"], settings["loader"], source)
    return config if made is None else config.for_model(made)


def _config_of_dataset(folder: Path) -> BuildConfig:
    manifest = Manifest.read(folder)
    model = {"name": manifest.model["name"], **manifest.model["choices"]} if manifest.model else None
    output = {
        "format": manifest.format,
        "compression": manifest.compression,
        "keep_raw": (folder / "raw").is_dir(),
    }
    common = {"source": dict(manifest.source), "output": output}
    name = str(folder / FILE_NAME)
    config = config_from_yaml(yaml_text({**common, **({"model": model} if model else manifest.pipeline)}), name=name)
    if model and config.pipeline.to_config() != manifest.pipeline:  # the steps of the model were changed by hand
        config = config_from_yaml(yaml_text({**common, **manifest.pipeline}), name=name)
    return replace(config, source=replace(config.source, path=None, by_name=True))


def _settings(document: YamlDocument, model: type[BaseModel], node: yaml.Node | None) -> Any:
    entries = document.mapping(node, model.__name__.lower())
    values = {key: document.plain(value) for key, (_, value) in entries.items()}
    try:
        return model(**values)
    except ValidationError as error:
        for fault in error.errors():
            name = str(fault["loc"][0])
            if fault["type"] == "extra_forbidden":
                hint = near_matches(name, model.model_fields) or f"; known: {', '.join(model.model_fields)}"
                document.fault(entries[name][0], f"{model.__name__.lower()}.{name}: no such setting{hint}")
            else:
                place = node_at(entries[name][1], fault["loc"][1:]) if name in entries else node
                document.fault(place, f"{model.__name__.lower()}.{name}: {fault['msg']} (got {fault['input']!r})")
        return None
