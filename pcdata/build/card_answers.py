"""What only people know of a dataset: license, sensor, conditions; kept in its ``card.yaml``."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from pcdata.errors import ConfigError, near_matches
from pcdata.files.opening import read_text, replacing
from pcdata.yaml_nodes import YamlDocument

FILE_NAME = "card.yaml"
UNKNOWN = "UNKNOWN"

_LONGEST = 2000  # characters


@dataclass(frozen=True)
class CardAnswers:
    """Answers for the card; None = not known.

    Args:
        license: of the source data, such as ``cc-by-4.0``.
        license_link: where its text is.
        sensor: model, serial and settings of the depth camera.
        conditions: of the captures: lighting, surfaces, working range.
        creator: who made the data.
        url: where the dataset or its source is at home.
        date_published: as 2026-01-29.
        title: of the card.
        description: one or two sentences.
    """

    license: str | None = None
    license_link: str | None = None
    sensor: str | None = None
    conditions: str | None = None
    creator: str | None = None
    url: str | None = None
    date_published: str | None = None
    title: str | None = None
    description: str | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and (not isinstance(value, str) or not value.strip() or len(value) > _LONGEST):
                raise ConfigError(
                    f"card: {field.name} must be a text of at most {_LONGEST} characters, got {value!r:.100}; a "
                    "date or a number needs quotes in YAML"
                )
        if self.date_published is not None:
            try:
                datetime.date.fromisoformat(self.date_published)
            except ValueError as error:
                raise ConfigError(
                    f"card: date_published must be a date such as 2026-01-29, got {self.date_published!r:.100}"
                ) from error
        for name in ("url", "license_link"):
            value = getattr(self, name)
            if value is not None and not value.startswith(("https://", "http://")):
                raise ConfigError(f"card: {name} must begin with https:// or http://, got {value!r:.100}")

    @classmethod
    def of(cls, where: str, given: Mapping[str, Any]) -> CardAnswers:
        """Return answers by name.

        Raises:
            ConfigError: a name that none has, or a value that is no answer.
        """
        known = [field.name for field in fields(cls)]
        for name in given:
            if name not in known:
                hint = near_matches(str(name), known) or f"; known: {', '.join(known)}"
                raise ConfigError(f"{where}: no answer is called {name!r:.100}{hint}")
        return cls(**given)

    @classmethod
    def read(cls, path: Path) -> CardAnswers:
        """Read a YAML file.

        Raises:
            ConfigError: it is damaged, or says what no answer is.
        """
        document = YamlDocument(read_text("card", path, error=ConfigError), str(path))
        entries = document.mapping(document.root, "card")
        document.raise_faults()
        return cls.of(str(path), {name: document.plain(value) for name, (_, value) in entries.items()})

    def with_others(self, given: Mapping[str, str | None]) -> CardAnswers:
        """Return these with those that are given in their place."""
        return replace(self, **{name: value for name, value in given.items() if value is not None})

    def write(self, path: Path) -> None:
        """Write the answers that there are.

        Raises:
            CacheError: it cannot be written.
        """
        import yaml

        said = {field.name: value for field in fields(self) if (value := getattr(self, field.name)) is not None}
        text = yaml.safe_dump(said, sort_keys=False, allow_unicode=True) if said else "{}\n"
        with replacing("card", path) as temporary:
            temporary.write_text(text, encoding="utf-8")
