"""Code, docs and messages keep American spelling, as the names of the field do."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
BRITISH = (
    *("colour", "neighbour", "behaviour", "favour", "honour", "organis", "normalis", "recognis", "vectoris"),
    *("initialis", "serialis", "summaris", "optimis", "minimis", "maximis", "quantis", "catalogue", "labelled"),
    *("modelled", "cancelled", "judgement", "artefact", "licence", "grey", "centre", "analyse"),
)
ACCEPTED = {"colour", "colourimage"}  # names of folders that other people's captures have


def british_words(text: str) -> set[str]:
    """The words of a text that are spelled the British way; nearly no text has one."""
    text = text.lower()
    stems = [stem for stem in BRITISH if stem in text]
    return {word for word in re.findall(r"\w+", text if stems else "") if any(stem in word for stem in stems)}


def test_words_are_spelled_as_in_american_english():
    paths = [path for folder in ("pcdata", "benchmarks", "examples", "configs") for path in (ROOT / folder).rglob("*")]
    paths += [path for path in (ROOT / "tests").rglob("*.py") if path != Path(__file__)]
    paths += [*(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md")]
    found = {
        f"{path.relative_to(ROOT)}: {word}"
        for path in paths
        if path.suffix in {".py", ".md", ".yaml", ".cpp", ".hpp"}
        for word in british_words(path.read_text(encoding="utf-8")) - ACCEPTED
    }
    assert found == set()


def test_a_british_word_is_seen_in_any_name():
    assert british_words("The_Colours of a neighbour, centred") == {"the_colours", "neighbour", "centred"}
