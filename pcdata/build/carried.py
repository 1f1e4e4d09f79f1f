"""What a dataset that replaces another takes over from it: which samples are held out, so that none ever moves."""

from __future__ import annotations

from pathlib import Path

from pcdata.datasets.split_dataset import added
from pcdata.datasets.split_groups import SampleFacts
from pcdata.datasets.splits import FILE_NAME, Splits
from pcdata.errors import ConfigError
from pcdata.io.store.manifest import Manifest


def carry_splits(old: Path, new: Path) -> str | None:
    """Write the splits of an old dataset into the one that takes its place, with what is new added.

    Args:
        old: the folder that is replaced; it may have no splits, or not be there.
        new: the new dataset, complete but for this.

    Returns:
        What to know: samples could not be added by the rules of the file; None = nothing.

    Raises:
        CacheError: the splits are damaged, or cannot be written.
    """
    if not (old / FILE_NAME).is_file():
        return None
    manifest = Manifest.read(new)
    splits = Splits.read(old)
    facts = SampleFacts(new, [sample.id for sample in manifest.samples], manifest.episodes, None)
    note = None
    try:
        splits = added(facts, splits, {})
    except ConfigError as error:
        note = f"{FILE_NAME} is that of the dataset before; add what is new with 'pcdata split': {error}"
    splits.write(new / FILE_NAME)
    return note
