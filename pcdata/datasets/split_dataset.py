"""Draw the splits of a built dataset, or add what is new to them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pcdata.contracts.numbers import whole_number
from pcdata.datasets.split_drawing import Parts, draw_parts
from pcdata.datasets.split_groups import SampleFacts, Table, strata_of
from pcdata.datasets.splits import FILE_NAME, Splits
from pcdata.errors import CacheError, ConfigError, near_matches
from pcdata.files.locks import release, try_lock
from pcdata.io.store.manifest import Manifest

DEFAULT_PARTS: Parts = {"train": 0.8, "val": 0.1, "test": 0.1}
# Scenes of a published data set by split, as its own loader has them: first, last.
# Source: graspnetAPI, graspnet.py (GraspNet.__init__); graspnet-baseline, dataset/graspnet_dataset.py.
PUBLISHED: Mapping[str, Mapping[str, tuple[int, int]]] = {
    "graspnet": {"train": (0, 99), "test_seen": (100, 129), "test_similar": (130, 159), "test_novel": (160, 189)},
}

_SCENE = re.compile(r"scene_?([0-9]{1,4})(?![0-9])")
_BY_SCENE = "id:scene_?[0-9]{1,4}(?![0-9])"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")  # a split becomes the name of a folder or of a list of files
_DRAWN = {"by": "sample", "parts": dict(DEFAULT_PARTS), "seed": 0, "stratify": []}


def split_dataset(
    folder: str | Path,
    parts: Parts | None = None,
    *,
    by: str | None = None,
    named_by: str | None = None,
    stratify: Sequence[str] | None = None,
    seed: int | None = None,
    table: Table | None = None,
    path: str | Path | None = None,
    fresh: bool = False,
) -> Splits:
    """Write which samples of a built dataset are for training and which are held out, to its ``splits.json``.

    Groups of samples are drawn as :func:`pcdata.datasets.split_drawing.draw_parts` says. Where the file is there
    already its samples stay where they are, whatever was built since: only what is new is added, by the rules that the
    file keeps.

    Args:
        folder: the dataset.
        parts: split -> a share of the groups, a whole number of them, or None = the rest; None = 80, 10 and 10 % for
            train, val and test.
        by: the rule that says which samples stand together: ``sample``, ``episode``, ``folder`` (what is before the
            last / of the id), ``id:REGEX`` (the match, or its groups), ``column:NAME`` of the table, ``signal:NAME``,
            ``meta:NAME``. None = episodes where there are any, else samples; ids with a / must be told.
        named_by: instead of a draw: a name of :data:`PUBLISHED`, or a rule that gives the name of the split.
        stratify: rules whose values every split is to have in like shares; a number with many values is taken by
            quarters.
        seed: of the draw; None = 0.
        table: a CSV file with the column ``sample``, a JSON file or a mapping from sample id to named values.
        path: of the file; None = in the dataset.
        fresh: draw anew, whatever the file says.

    Raises:
        ConfigError: a rule that does not fit the samples, parts that do not add up or too few groups, a group or a
            recorded episode that would be in two splits, or another rule than that of the file.
        CacheError: the dataset or the file is damaged or cannot be written, or another process writes it.
    """
    folder = Path(folder)
    file = folder / FILE_NAME if path is None else Path(path)
    manifest = Manifest.read(folder)
    facts = SampleFacts(folder, manifest.index.ids, manifest.episodes, table)
    given = {
        "by": by,
        "parts": None if parts is None else _plain_parts(parts),
        "seed": None if seed is None else whole_number("split", "seed", seed),
        "stratify": None if stratify is None else list(stratify),
        "named_by": named_by,
    }
    with _alone(folder):
        old = None if fresh or not file.is_file() else Splits.read(file)
        splits = added(facts, old, {name: value for name, value in given.items() if value is not None})
        splits.write(file)
    return splits


def added(facts: SampleFacts, old: Splits | None, given: Mapping[str, Any]) -> Splits:
    """Return the splits of samples: those of ``old`` stay as they are, all others are added.

    Raises:
        ConfigError: see :func:`split_dataset`.
    """
    settings = _settings(facts, old, given)
    groups = facts.values(settings["by"])
    kept = _kept(facts.ids, groups, old)
    if "named_by" in settings:
        part_of = _named(facts, groups, settings["named_by"])
        names = [*PUBLISHED.get(settings["named_by"], ()), *part_of.values()]
        if moved := [group for group, part in kept.items() if part_of[group] != part]:
            raise ConfigError(
                f"split: {moved[0]!r:.100} is in {kept[moved[0]]!r} and would move to {part_of[moved[0]]!r}; what was "
                "tested with it would change: correct the names, or draw all anew with --fresh"
            )
    else:
        strata = strata_of(groups, [facts.values(rule) for rule in settings["stratify"]])
        part_of = draw_parts("split", strata, settings["parts"], settings["seed"], kept=kept)
        names = list(settings["parts"])
    _check_episodes(facts, groups, part_of)
    found: dict[str, dict[str, list[str]]] = {name: {} for name in dict.fromkeys(names)}
    own = {*facts.ids}
    absent = []
    for split, by_group in (old.groups if old else {}).items():
        for group, ids in by_group.items():
            gone = [one for one in ids if one not in own]
            absent += gone
            if gone:
                found.setdefault(split, {})[group] = gone
    for sample_id, group in zip(facts.ids, groups):
        found[part_of[group]].setdefault(group, []).append(sample_id)
    return Splits(found, settings, absent)


def _settings(facts: SampleFacts, old: Splits | None, given: Mapping[str, Any]) -> dict[str, Any]:
    known = dict(old.settings) if old is not None else {}
    for name, value in given.items():
        if (name in known and known[name] != value) or (known and name not in known):
            said = f"{name} {known[name]!r}" if name in known else f"no {name}"
            raise ConfigError(
                f"split: the file says {said}, and {value!r:.200} was given; what was added by another rule would not "
                "fit what is there: leave it out, write another file (--file), or draw all anew with --fresh"
            )
    settings = known or dict(given)
    if "named_by" in settings:
        if clash := [name for name in ("parts", "seed", "stratify") if name in settings]:
            raise ConfigError(f"split: {', '.join(clash)} is of a draw, and named_by names every split; drop one")
        published = settings["named_by"] in PUBLISHED
        settings.setdefault("by", _BY_SCENE if published else None)
    elif not known:
        settings = {**_DRAWN, "by": None, **settings}
    if settings.get("by") is None:
        settings["by"] = facts.default_rule()
    return settings


def _plain_parts(parts: Any) -> dict[str, Any]:
    if not isinstance(parts, Mapping):
        raise ConfigError(f"split: parts must map names to how much, got {parts!r:.100}")
    _check_names(parts)
    return {name: part.item() if isinstance(part, np.generic) else part for name, part in parts.items()}


def _check_names(names: Any) -> None:
    for name in names:
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise ConfigError(
                "split: a split must be called by letters, digits, '_', '-' and '.', since it becomes a file name, "
                f"got {name!r:.100}"
            )


def _kept(ids: Sequence[str], groups: Sequence[str], old: Splits | None) -> dict[str, str]:
    """Return group -> split of those that have one, by their name or by a sample of theirs."""
    if old is None:
        return {}
    by_name = {group: split for split, by_group in old.groups.items() for group in by_group}
    by_id = old.part_of()
    kept: dict[str, str] = {}
    for sample_id, group in zip(ids, groups):
        for split in (by_name.get(group), by_id.get(sample_id)):
            if split is not None and kept.setdefault(group, split) != split:
                raise ConfigError(
                    f"split: {group!r:.100} holds samples of {kept[group]!r} and of {split!r} ({sample_id!r:.100}): "
                    "groups changed since the file was written; correct the table, or draw all anew with --fresh"
                )
    return kept


def _named(facts: SampleFacts, groups: Sequence[str], named_by: str) -> dict[str, str]:
    if named_by in PUBLISHED:
        names = [_published(named_by, one) for one in facts.ids]
    elif ":" in named_by or named_by == "folder":
        names = facts.values(named_by)
    else:
        raise ConfigError(
            f"split: {named_by!r:.100} is no published data set{near_matches(named_by, PUBLISHED)} and no rule; known: "
            f"{', '.join(PUBLISHED)}, or a rule that names the split, such as column:split"
        )
    _check_names(dict.fromkeys(names))
    part_of: dict[str, str] = {}
    for sample_id, group, name in zip(facts.ids, groups, names):
        if part_of.setdefault(group, name) != name:
            raise ConfigError(
                f"split: {group!r:.100} would be in two splits, {part_of[group]!r} and {name!r} ({sample_id!r:.100})"
            )
    return part_of


def _published(data_set: str, sample_id: str) -> str:
    found = _SCENE.search(sample_id)
    for split, (first, last) in PUBLISHED[data_set].items():
        if found is not None and first <= int(found[1]) <= last:
            return split
    last = max(last for _, last in PUBLISHED[data_set].values())
    raise ConfigError(
        f"split: sample {sample_id!r:.100} must name its scene, scene_0000 to scene_{last:04d}, for the splits of "
        f"{data_set}; give the folder of all scenes to the build, or name the splits by a table"
    )


def _check_episodes(facts: SampleFacts, groups: Sequence[str], part_of: Mapping[str, str]) -> None:
    """Require that no recorded episode is in two splits: its frames are all but alike."""
    seen: dict[str, str] = {}
    for episode in facts.episodes:
        for place in episode.steps:
            split = part_of[groups[place]]
            if seen.setdefault(episode.whole, split) != split:
                raise ConfigError(
                    f"split: episode {episode.whole!r:.100} would be in {seen[episode.whole]!r} and in {split!r}, and "
                    "its steps are all but alike; group by episode, or by something that holds whole episodes"
                )


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the folder, so that of two that add to one file none loses what the other added."""
    held, is_taken = try_lock(folder)
    if is_taken:
        raise CacheError(f"{folder}: another process builds or splits it now; try again when it is done")
    try:
        yield
    finally:
        release(held)
