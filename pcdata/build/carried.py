"""What a dataset that replaces another takes over from it: which samples are held out, and what people said of it."""

from __future__ import annotations

from pathlib import Path

from pcdata.build.card_answers import FILE_NAME as ANSWERS
from pcdata.build.card_answers import CardAnswers
from pcdata.datasets.split_dataset import added
from pcdata.datasets.split_groups import SampleFacts
from pcdata.datasets.splits import FILE_NAME, Splits
from pcdata.errors import ConfigError
from pcdata.io.store.manifest import Manifest


def carry_answers(old: Path, new: Path) -> None:
    """Copy what people said for the card of an old dataset into the one that takes its place.

    Raises:
        ConfigError: it is damaged.
    """
    if (old / ANSWERS).is_file():
        CardAnswers.read(old / ANSWERS).write(new / ANSWERS)


def carry_splits(old: Path, new: Path) -> list[str]:
    """Write the splits of an old dataset into the one that takes its place, with what is new added.

    Args:
        old: the folder that is replaced, which has splits.
        new: the new dataset, complete but for this.

    Returns:
        What to know: that new samples could not be added by the rules of the file.

    Raises:
        CacheError: the splits are damaged, or cannot be written.
    """
    manifest = Manifest.read(new)
    splits = Splits.read(old)
    facts = SampleFacts(new, manifest.index.ids, manifest.episodes, None)
    notes = []
    try:
        splits = added(facts, splits, {})
    except ConfigError as error:
        notes.append(f"{FILE_NAME} is that of the dataset before; add what is new with 'pcdata split': {error}")
    splits.write(new / FILE_NAME)
    return notes
