"""The card of a dataset: ``README.md`` for people and Hugging Face, ``croissant.json`` for machines.

Both are filled from what happened: the manifest, the index, the splits and the first cloud. What nobody could know but
the people who made the captures is asked for (:class:`CardAnswers`), and ``UNKNOWN`` until they say it. The bytes
follow from the dataset and the answers alone: no time, no name of a machine.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from pcdata.build.card_answers import FILE_NAME as ANSWERS
from pcdata.build.card_answers import CardAnswers
from pcdata.build.card_facts import CardFacts
from pcdata.build.card_text import card_text
from pcdata.build.croissant import croissant_text
from pcdata.build.written_texts import edited_texts, write_texts
from pcdata.errors import ConfigError
from pcdata.io.store.manifest import Manifest

README, CROISSANT = "README.md", "croissant.json"
CARD_FILES = (README, CROISSANT, ANSWERS)


def write_card(
    folder: str | os.PathLike[str],
    answers: Mapping[str, str | None] | None = None,
    *,
    strict: bool = False,
    overwrite: bool = False,
) -> list[str]:
    """Write the card of a dataset anew, as after a split; return what is not known, and how to say it.

    Args:
        folder: the dataset.
        answers: fields of :class:`~pcdata.build.card_answers.CardAnswers` by name; they are kept in ``card.yaml``.
        strict: write nothing where something is not known.
        overwrite: also what somebody edited by hand.

    Raises:
        ConfigError: a name or a value that is no answer; with ``strict`` something is not known: names it all; a file
            of the card was edited by hand.
        CacheError: the dataset is damaged.
        WriteError: a file cannot be written.
    """
    folder = Path(folder)
    said = CardAnswers.read(folder / ANSWERS) if (folder / ANSWERS).is_file() else CardAnswers()
    given = {name: value for name, value in (answers or {}).items() if value is not None}
    if given:
        said = said.with_others(vars(CardAnswers.of("card", given)))
    if not overwrite and (edited := [name for name in edited_texts(folder) if name in (README, CROISSANT)]):
        raise ConfigError(
            f"card: {' and '.join(edited)} of {folder} {'were' if len(edited) > 1 else 'was'} edited by hand, which "
            "would be lost; keep a copy elsewhere and allow overwriting (--overwrite)"
        )
    facts = CardFacts.of(folder, Manifest.read(folder), said)
    missing = facts.missing()
    if strict and missing:
        raise ConfigError("card: these are not known, and strict wants all of them:\n" + "\n".join(missing))
    if given:
        said.write(folder / ANSWERS)
    write_texts(folder, card_texts(facts))
    return missing


def card_texts(facts: CardFacts) -> dict[str, str]:
    """Return the files of a card by name."""
    return {README: card_text(facts), CROISSANT: croissant_text(facts)}
