"""The build configuration: pipeline sections, and how the result is stored and loaded."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge
from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError, model_validator

from pcdata.build.model_section import preset_of_section, stored_preset
from pcdata.build.source_section import SourceSettings, source_settings
from pcdata.datasets.collate import COLLATES
from pcdata.datasets.windows import checked_numbers
from pcdata.errors import ConfigError, locates_path, near_matches
from pcdata.files.opening import read_text
from pcdata.io.store.manifest import FILE_NAME, Manifest
from pcdata.io.store.stores import STORES, Compression
from pcdata.models import Preset
from pcdata.registry import Registry
from pcdata.structures import PointCloud
from pcdata.transforms import Compose
from pcdata.transforms.chain_reading import SECTIONS
from pcdata.transforms.sensor_words import SENSOR
from pcdata.yaml_nodes import Document, YamlDocument, yaml_text
from pcdata.yaml_paths import set_value


def _registered(registry: Registry[Any]) -> AfterValidator:
    """Accept the names of a registry, of one's own too."""

    def check(name: str) -> str:
        if name not in registry:
            hint = near_matches(name, registry)
            raise ValueError(f"must be one of {', '.join(registry)}{hint}; one of your own needs --import FILE.py")
        return name

    return AfterValidator(check)


Format = Annotated[str, _registered(STORES)]
Collate = Annotated[str, _registered(COLLATES)]


class _Output(BaseModel):
    """How clouds are stored."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Format = "hdf5"
    compression: Compression = "none"  # lzf (hdf5) or gzip; reads are 2-4 times faster without
    keep_raw: bool = False  # also deliver depth, color and calibration beside the clouds
    compact: bool = False  # colors as bytes, normals as two 16-bit numbers: see docs/training.md
    shard_size: Annotated[int, Ge(1)] | None = None  # captures; None = such that there are at most 1,000 shards


class Windows(BaseModel):
    """Windows over the episodes of the dataset, as :class:`pcdata.EpisodeWindows` cuts them."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    num_obs: int
    horizon: int
    num_actions: int | None = None
    stride: int = 1
    pad: Literal["repeat", "drop"] = "repeat"
    actions: tuple[str, ...] = ("action",)

    @model_validator(mode="after")
    def _make_windows(self) -> Windows:
        checked_numbers(self.num_obs, self.horizon, self.num_actions, self.stride, self.pad)
        return self


class Loader(BaseModel):
    """What the loading script written into the dataset does."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    batch_size: Annotated[int, Ge(1)] = 8
    num_workers: Annotated[int, Ge(0)] = 2
    collate: Collate = "packed"  # of windows: "windows"
    buckets: tuple[Annotated[int, Ge(1)], ...] = ()  # lengths that padded batches are rounded up to; none = any
    seed: int = 0
    split: str | None = None  # which samples, as "pcdata split" draws them; None = all
    windows: Windows | None = None  # of clouds and actions, where the source has episodes; None = single clouds

    @model_validator(mode="before")
    @classmethod
    def _stack_windows(cls, values: Any) -> Any:
        """Let windows be stacked where nothing else is said."""
        return {"collate": "windows", **values} if isinstance(values, dict) and values.get("windows") else values

    @model_validator(mode="after")
    def _have_windows(self) -> Loader:
        if self.buckets and self.collate != "padded":
            raise ValueError(f"buckets are lengths of padded batches; write collate: padded, not {self.collate}")
        if list(self.buckets) != sorted({*self.buckets}):
            raise ValueError(f"buckets must rise, as in [1024, 2048, 4096], got {list(self.buckets)}")
        if self.collate == "windows" and self.windows is None:
            raise ValueError("collate: windows stacks windows; say which: windows: {num_obs: 2, horizon: 16}")
        return self


@dataclass(frozen=True)
class BuildConfig:
    """A parsed configuration file; without one, everything at its default."""

    pipeline: Compose = field(default_factory=lambda: Compose([]))
    output: _Output = field(default_factory=_Output)
    loader: Loader = field(default_factory=Loader)
    source: SourceSettings = field(default_factory=SourceSettings)
    model: Preset | None = None  # whose preset the pipeline is

    def for_model(self, made: Preset) -> BuildConfig:
        """Return this configuration, which has no steps, with those of a model's preset.

        Raises:
            ConfigError: it has steps or a model already, or the model takes no clouds that a build stores.
        """
        if self.model is not None:
            raise ConfigError(f"the configuration names the model {self.model.contract.name} already; name one only")
        if len(self.pipeline):
            raise ConfigError(
                f"the configuration has steps of its own, and the preset of {made.contract.name} has its own; drop one"
            )
        for name in ("windows", "collate"):
            if name in self.loader.model_fields_set:
                raise ConfigError(f"loader.{name}: the model's preset makes its own batches; leave it out")
        return replace(self, pipeline=stored_preset(made).pipeline, model=made)

    def to_yaml(self) -> str:
        """Write every setting, as :func:`load_config` reads it: steps with all their fields, paths as they are here."""
        source = self.source.to_config()
        steps = self.pipeline.sections() if self.model is None else {"model": self._model_section()}
        hidden = None if self.model is None else {"collate", "windows"}  # the preset's own
        parts = {
            **({"source": source} if source else {}),
            **steps,
            "output": self.output.model_dump(mode="json"),
            "loader": self.loader.model_dump(mode="json", exclude=hidden),
        }
        return yaml_text(parts)

    def _model_section(self) -> dict[str, Any]:
        assert self.model is not None
        return {"name": self.model.contract.name, **self.model.plain_choices()}

    def stored_as(self, format: str) -> BuildConfig:
        """Return this configuration with another format of storage.

        Raises:
            ConfigError: there is no such format, or it does not know the compression.
        """
        known = STORES.named("output.format", format).compressions
        output = self.output.model_copy(update={"format": format})
        if output.compression not in known:
            raise ConfigError(f"format {format} knows the compression {', '.join(known)}, not {output.compression}")
        return replace(self, output=output)


_SETTINGS: dict[str, type[BaseModel]] = {"output": _Output, "loader": Loader}


@locates_path
def load_config(path: str | Path, *, settings: Iterable[tuple[str, str]] = ()) -> BuildConfig:
    """Read a YAML file; its sections source, sensor, depth, cloud, augment, model, output and loader are optional.

    The folder of a built dataset stands for the configuration that builds it again: its steps, its storage and how its
    captures were read, without their place.

    ``source`` says where the captures are, how they are read and which are left out; paths in it start from the folder
    of the file.

    ``model`` is ``{name: MODEL, CHOICE: VALUE, ...}``: the steps are those of the model's preset.

    ``settings`` are pairs of a path and a value as YAML writes it, which go before what the file says:
    ``("cloud.FarthestPointSample.num_points", "2048")``. A step is named by its class, or by its place in its section.

    ``sensor`` is a name that ``pcdata profiles`` lists, or ``{name: ..., depth: metres}``: what the steps' values
    ``sensor`` are computed from.

    Raises:
        ConfigError: every fault, as ``file:line:column: what``.
        CacheError: the dataset's ``dataset.json`` is damaged.
    """
    if (Path(path) / FILE_NAME).is_file():
        return _config_of_dataset(Path(path), tuple(settings))
    text = read_text("configuration", path, error=ConfigError)
    return config_from_yaml(text, name=str(path), folder=Path(path).parent, settings=settings)


def config_from_yaml(
    text: str, *, name: str = "<yaml>", folder: Path | None = None, settings: Iterable[tuple[str, str]] = ()
) -> BuildConfig:
    """Parse the text of a configuration; see :func:`load_config`. Relative paths in it start from ``folder``."""
    document = YamlDocument(text, name)
    for path, value in settings:
        set_value(document, path, value)
    return _config_of(document, folder)


def _config_of(document: Document, folder: Path | None = None) -> BuildConfig:
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
    if output is not None and output.compression not in STORES[output.format].compressions:
        known_here = ", ".join(STORES[output.format].compressions)
        document.fault(
            document.at(entries["output"][1], ["compression"]),
            f"output.compression: format {output.format} knows {known_here}, not {output.compression}",
        )
    source = source_settings(document, entries["source"][1] if "source" in entries else None, folder)
    made = preset_of_section(document, entries)
    pipeline = Compose.from_sections(document, entries)
    if pipeline.gives is not PointCloud:
        document.fault(entries["depth"][0], "the section depth must end in points; put Deproject last")
        document.raise_faults()
    config = BuildConfig(pipeline, settings["output"], settings["loader"], source)
    return config if made is None else config.for_model(made)


def _config_of_dataset(folder: Path, settings: Sequence[tuple[str, str]] = ()) -> BuildConfig:
    manifest = Manifest.read(folder)
    model = {"name": manifest.model["name"], **manifest.model["choices"]} if manifest.model else None
    output = {
        "format": manifest.format,
        "compression": manifest.compression,
        "keep_raw": manifest.keep_raw,
        "shard_size": manifest.shard_size,
        "compact": manifest.compact,
    }
    common = {"source": dict(manifest.source), "output": output}
    name = str(folder / FILE_NAME)
    config = _config_of(Document({**common, **({"model": model} if model else manifest.pipeline)}, name))
    if model and config.pipeline.sections() != manifest.pipeline:  # the steps of the model were changed by hand
        config = _config_of(Document({**common, **manifest.pipeline}, name))
    if settings:
        config = config_from_yaml(config.to_yaml(), name=name, settings=settings)
    return replace(config, source=replace(config.source, path=None, by_name=True))


def _settings(document: Document, model: type[BaseModel], node: Any) -> Any:
    section = model.__name__.lower().lstrip("_")
    entries = document.mapping(node, section)
    values = {key: document.plain(value) for key, (_, value) in entries.items()}
    try:
        return model(**values)
    except ValidationError as error:
        for fault in error.errors():
            name = str(fault["loc"][0]) if fault["loc"] else "collate"  # the one rule of several settings
            if fault["type"] == "extra_forbidden":
                hint = near_matches(name, model.model_fields) or f"; known: {', '.join(model.model_fields)}"
                document.fault(entries[name][0], f"{section}.{name}: no such setting{hint}")
            else:
                place = document.at(entries[name][1], fault["loc"][1:]) if name in entries else node
                document.fault(place, f"{section}.{name}: {fault['msg']} (got {fault['input']!r})")
        return None
