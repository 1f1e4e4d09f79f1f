"""Pipeline: the whole way from a capture to a training sample, in three named sections."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from itertools import zip_longest
from typing import Any

import yaml

from pcdata.errors import ConfigError
from pcdata.structures import DepthFrame, PointCloud
from pcdata.transforms.base import Data, GeneratorLike, Transform
from pcdata.transforms.compose import Compose, opened, order_checked_before
from pcdata.transforms.config import read_config, steps_from_node
from pcdata.transforms.sensor_words import SENSOR, sensor_from_node
from pcdata.yaml_nodes import YamlDocument, yaml_text

SECTIONS = ("depth", "cloud", "augment")


class Pipeline(Transform, abstract=True):
    """``depth`` turns a capture into points, ``cloud`` works on points, ``augment`` is drawn anew for every epoch.

    A capture that already is a cloud (PCD, PLY) enters at ``cloud``. What a build may store is everything before the
    first random step, wherever that is.

    Raises:
        ConfigError: a section takes or gives the wrong kind of data, or neighbours do not fit.
    """

    depth: Sequence[Transform] = ()
    cloud: Sequence[Transform] = ()
    augment: Sequence[Transform] = ()

    takes = (DepthFrame, PointCloud)  # type: ignore[assignment]

    def check_fields(self) -> None:
        """Check each section and the joints between them."""
        if self.depth and self.depth[-1].gives is not PointCloud:
            raise ConfigError("Pipeline: the section depth must end in points; put Deproject last")
        if self.depth and self.depth[0].takes is not DepthFrame:
            raise ConfigError(
                f"Pipeline: the section depth must start with a step that takes a capture, not with "
                f"{type(self.depth[0]).__name__}, which takes a {self.depth[0].takes.__name__}"
            )
        for section in ("cloud", "augment"):
            for step in getattr(self, section):
                if step.takes is not PointCloud:
                    raise ConfigError(
                        f"Pipeline: {type(step).__name__} takes a {step.takes.__name__}; it belongs into the section "
                        f"depth, not {section}"
                    )
        self._from_depth = Compose([*self.depth, *self.cloud, *self.augment])
        with order_checked_before():
            self._from_cloud = Compose([*self.cloud, *self.augment])
        self.is_random = self._from_depth.is_random  # type: ignore[misc]

    def forward(self, data: Data, *, generator: GeneratorLike | None = None) -> Any:
        """Run all sections that apply to the data."""
        return self._entered_by(data)(data, generator=generator)

    def step_through(self, data: Data, *, generator: GeneratorLike | None = None) -> Iterator[tuple[Transform, Any]]:
        """Yield ``(step, data)`` after every step."""
        return self._entered_by(data).step_through(data, generator=generator)

    def deterministic_prefix(self) -> Pipeline:
        """The steps before the first random one: what a cache holds."""
        count = len(self._from_depth.split()[0])
        kept: dict[str, list[Transform]] = {}
        for section in SECTIONS:
            kept[section] = list(opened(getattr(self, section)))[:count]
            count -= len(kept[section])
        with order_checked_before():
            return Pipeline(**kept)

    def random_suffix(self) -> Compose:
        """The steps from the first random one on: what runs on cached clouds."""
        return self._from_depth.split()[1]

    def fingerprint(self) -> str:
        """SHA-256 of the deterministic prefix, section by section: equal for caches that hold the same clouds."""
        prefix = self.deterministic_prefix()
        with order_checked_before():
            parts = [Compose(list(getattr(prefix, section))).fingerprint() for section in SECTIONS]
        return hashlib.sha256("".join(parts).encode()).hexdigest()

    def difference(self, other: Pipeline) -> str:
        """Say where two pipelines' deterministic steps first differ."""
        ours, theirs = self.deterministic_prefix(), other.deterministic_prefix()
        for section in SECTIONS:
            pairs = zip_longest(getattr(ours, section), getattr(theirs, section))
            for position, (mine, stored) in enumerate(pairs, start=1):
                if mine is None or stored is None or mine.fingerprint() != stored.fingerprint():
                    return f"in {section}, step {position}: {mine or 'nothing'} here, {stored or 'nothing'} there"
        return "a transform's version changed"

    def to_config(self) -> dict[str, Any]:
        """Return the sections as lists of ``{transform: fields}``."""
        return {section: [step.to_config() for step in getattr(self, section)] for section in SECTIONS}

    def to_yaml(self) -> str:
        """Write the sections as YAML that :meth:`from_yaml` reads back."""
        return yaml_text(self.to_config())

    @classmethod
    def from_config(cls, sections: Mapping[str, Any]) -> Pipeline:
        """Build from plain data, the form that :meth:`to_config` returns."""
        return cls.from_yaml(yaml_text(dict(sections)), name="<config>")

    @classmethod
    def from_yaml(cls, text: str, *, name: str = "<yaml>") -> Pipeline:
        """Build from YAML with the sections ``depth``, ``cloud`` and ``augment``, and perhaps the name of a ``sensor``.

        Where a step says ``sensor`` for a value, the value is computed here: the pipeline holds the number.

        Raises:
            ConfigError: every fault, as ``name:line:column: what``.
        """
        document = YamlDocument(text, name)
        entries = document.mapping(document.root, "a pipeline")
        for section, (key, _) in entries.items():
            if section not in (*SECTIONS, SENSOR):
                document.fault(key, f"unknown section {section!r}; a pipeline has {', '.join(SECTIONS)}")
        return pipeline_from_document(document, entries)

    @classmethod
    def load(cls, path: str) -> Pipeline:
        """Build from a YAML file."""
        return cls.from_yaml(read_config(path), name=str(path))

    def _entered_by(self, data: Data) -> Compose:
        if isinstance(data, PointCloud):
            return self._from_cloud
        if not self.depth:
            raise ConfigError("Pipeline: a depth capture was given but the section depth is empty; add Deproject to it")
        return self._from_depth


def pipeline_from_document(document: YamlDocument, entries: Mapping[str, tuple[yaml.Node, yaml.Node]]) -> Pipeline:
    """Build the pipeline sections of a parsed file and raise all faults noted so far."""
    if SENSOR in entries:
        document.sensor = sensor_from_node(document, entries[SENSOR][1])
    steps = {
        section: steps_from_node(document, entries[section][1], f"section {section}")
        for section in SECTIONS
        if section in entries
    }
    document.raise_faults()
    try:
        return Pipeline(**steps)
    except ConfigError as error:
        raise ConfigError(f"{document.name}: {error}") from error
