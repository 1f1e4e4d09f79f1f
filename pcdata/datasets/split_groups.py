"""What must stay together in a split: the group of every sample, by a stated rule."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from pcdata.datasets.cached import CachedCloudDataset
from pcdata.errors import ConfigError, near_matches
from pcdata.files.sample_table import read_sample_table
from pcdata.structures import Episode

Table = str | Path | Mapping[str, Mapping[str, Any]]

RULES = ("sample", "episode", "folder", "id:REGEX", "column:NAME", "signal:NAME", "meta:NAME")
_BINS = 4  # of a number that has more values than _FEW, so that each holds a quarter of the samples
_FEW = 8
_SHOWN = 3


class SampleFacts:
    """What is known of the samples of a dataset, by the rules that groups and strata are made with.

    Args:
        folder: the dataset.
        ids: its samples.
        episodes: over the ids.
        table: file or mapping from sample id to named values.
    """

    def __init__(self, folder: Path, ids: Sequence[str], episodes: Sequence[Episode], table: Table | None) -> None:
        self.folder, self.ids, self.episodes = folder, list(ids), list(episodes)
        self._table: Mapping[str, Mapping[str, Any]] | None = None
        if table is not None:
            self._table = read_sample_table("split", table) if isinstance(table, (str, Path)) else table

    def values(self, rule: str) -> list[str]:
        """Return a text for every sample by a rule, one of :data:`RULES`.

        Raises:
            ConfigError: no such rule, or a sample has no value by it.
            CacheError: a sample that must be read for it is damaged.
        """
        kind, _, name = rule.partition(":") if isinstance(rule, str) else ("", "", "")
        plain: dict[str, Callable[[], list[str]]] = {
            "sample": lambda: list(self.ids),
            "episode": self._of_episodes,
            "folder": self._of_folders,
        }
        named: dict[str, Callable[[str], list[str]]] = {
            "id": self._of_pattern,
            "column": self._of_column,
            "signal": self._of_signal,
            "meta": self._of_meta,
        }
        if rule in plain:
            return plain[rule]()
        if kind in named and name:
            return named[kind](name)
        raise ConfigError(
            f"split: {rule!r:.100} is no rule that groups samples{near_matches(str(rule), RULES)}; known: "
            f"{', '.join(RULES)}"
        )

    def default_rule(self) -> str:
        """Return how samples are grouped where nothing is said.

        Raises:
            ConfigError: they could be frames of one scene, so somebody has to say it.
        """
        if self.episodes:
            return "episode"
        if folders := [one for one in self.ids if "/" in one]:
            raise ConfigError(
                f"split: ids such as {folders[0]!r:.100} could be frames of one scene, which must not be in two "
                "splits; say what stays together: --by folder (what is before the last /), --by sample (each is a "
                f"scene), or another of {', '.join(RULES)}"
            )
        return "sample"

    def _of_episodes(self) -> list[str]:
        if not self.episodes:
            raise ConfigError(
                f"split: {self.folder} has no episodes; group by another rule: {', '.join(RULES)}, or say in "
                "episodes.json beside the captures which follow each other, and build again"
            )
        found = list(self.ids)  # a sample outside of all episodes stands alone
        for episode in self.episodes:
            for place in episode.steps:
                found[place] = episode.whole
        return found

    def _of_folders(self) -> list[str]:
        self._need("folder", [one for one in self.ids if "/" not in one], "have no / in their ids")
        return [one.rpartition("/")[0] for one in self.ids]

    def _of_pattern(self, pattern: str) -> list[str]:
        try:
            compiled = re.compile(pattern)
        except re.error as error:
            raise ConfigError(f"split: id:{pattern:.100} is no regular expression: {error}") from error
        found = [compiled.search(one) for one in self.ids]
        rule = f"id:{pattern}"
        self._need(rule, [one for one, match in zip(self.ids, found) if match is None], "do not match it")
        texts = ["/".join(str(part) for part in (match.groups() or [match[0]])) for match in found if match]
        self._need(rule, [one for one, text in zip(self.ids, texts) if not text], "match it with nothing")
        return texts

    def _of_column(self, name: str) -> list[str]:
        if self._table is None:
            raise ConfigError(f"split: column:{name} needs a table from sample id to values: --table FILE.csv or .json")
        rows = self._table
        self._need(f"column:{name}", [one for one in self.ids if one not in rows], "have no row in the table")
        known = list(dict.fromkeys(column for one in self.ids for column in rows[one]))
        if name not in known:
            raise ConfigError(
                f"split: the table has no column {name!r}{near_matches(name, known)}; it has {known!r:.200}"
            )
        return self._texts(f"column:{name}", [rows[one].get(name) for one in self.ids])

    def _of_signal(self, name: str) -> list[str]:
        table = CachedCloudDataset(self.folder, augment=None).signal_table()
        if name not in table:
            told = f"it has {', '.join(table)}" if table else "it has none"
            raise ConfigError(f"split: {self.folder} has no signal {name!r}{near_matches(name, table)}; {told}")
        values = table[name].values
        if not isinstance(values, Tensor):
            return self._texts(f"signal:{name}", list(values))
        if values.is_floating_point() or values[0].numel() != 1:
            raise ConfigError(
                f"split: signal:{name} must be a text or one whole number for each sample, got {tuple(values.shape)} "
                f"{values.dtype}"
            )
        return self._texts(f"signal:{name}", values.flatten().tolist())

    def _of_meta(self, name: str) -> list[str]:
        dataset = CachedCloudDataset(self.folder, augment=None)
        found = [dataset[place].meta[0].get(name) for place in range(len(dataset))]
        return self._texts(f"meta:{name}", found)

    def _texts(self, rule: str, values: Sequence[Any]) -> list[str]:
        lacking = [one for one, value in zip(self.ids, values) if value is None or value == ""]
        self._need(rule, lacking, "have no value")
        wrong = [one for one, value in zip(self.ids, values) if not isinstance(value, (str, int, float))]
        self._need(rule, wrong, "have a list or an object there, not a text or a number")
        return [str(value) for value in values]

    def _need(self, rule: str, wrong: Sequence[str], what: str) -> None:
        if wrong:
            shown = ", ".join(repr(one)[:100] for one in wrong[:_SHOWN])
            raise ConfigError(
                f"split: {rule:.100} must give every sample a value, but {len(wrong)} of {len(self.ids)} {what}: "
                f"{shown}{', ...' if len(wrong) > _SHOWN else ''}"
            )


def strata_of(groups: Sequence[str], attributes: Sequence[Sequence[str]]) -> dict[str, str]:
    """Return the stratum of every group: what its samples have of each attribute, all values of it in order.

    A number with many values, such as a count of objects, is taken by quarters of its range of ranks.

    Args:
        groups: (N,) of every sample.
        attributes: each (N,).
    """
    coarse = [_coarse(values) for values in attributes]
    found: dict[str, list[set[str]]] = {}
    for place, group in enumerate(groups):
        own = found.setdefault(group, [set() for _ in coarse])
        for values, of_all in zip(own, coarse):
            values.add(of_all[place])
    return {group: " | ".join(",".join(sorted(values)) for values in own) for group, own in found.items()}


def _coarse(values: Sequence[str]) -> Sequence[str]:
    try:
        numbers = np.array([float(value) for value in values])
    except ValueError:
        return values
    if len({*values}) <= _FEW or not np.isfinite(numbers).all():
        return values
    edges = np.quantile(numbers, np.arange(1, _BINS) / _BINS)
    return [f"quarter {int(place) + 1}" for place in np.searchsorted(edges, numbers, side="right")]
