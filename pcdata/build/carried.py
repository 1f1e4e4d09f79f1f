"""What a dataset that replaces another takes over from it: which samples are held out, and what people said of it."""

from __future__ import annotations

from pathlib import Path

from pcdata.build.card_answers import FILE_NAME as ANSWERS
from pcdata.build.card_answers import CardAnswers
from pcdata.datasets.split_dataset import added
from pcdata.datasets.split_groups import SampleFacts
from pcdata.datasets.splits import FILE_NAME, Splits
from pcdata.errors import ConfigError
from pcdata.files.scratch import Note
from pcdata.io.store.manifest import Manifest


def carried_answers(old: Path, new: Path) -> CardAnswers:
    """Copy what people said for the card of an old dataset into the one that takes its place, and return it.

    Raises:
        ConfigError: it is damaged.
    """
    if not (old / ANSWERS).is_file():
        return CardAnswers()
    answers = CardAnswers.read(old / ANSWERS)
    answers.write(new / ANSWERS)
    return answers


def carry_splits(old: Path, new: Path, manifest: Manifest, note: Note) -> None:
    """Write the splits of an old dataset, if it has any, into the one that takes its place, with what is new added.

    Args:
        old: the folder that is replaced.
        new: the new dataset, whose shards and manifest are there.
        manifest: its own.
        note: told where new samples cannot be added by the rules of the file.

    Raises:
        CacheError: the splits are damaged, or cannot be written.
    """
    if not (old / FILE_NAME).is_file():
        return
    splits = Splits.read(old)
    try:
        splits = added(SampleFacts(new, manifest.index.ids, manifest.episodes, None), splits, {})
    except ConfigError as error:
        note(f"{FILE_NAME} is that of the dataset before; add what is new with 'pcdata split': {error}")
    splits.write(new / FILE_NAME)
