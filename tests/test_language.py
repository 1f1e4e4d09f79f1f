"""Code, docs and messages keep American spelling, as the names of the field do."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
BRITISH = re.compile(
    r"colour|neighbour|behaviour|favour|honour|organis|normalis|recognis|vectoris|initialis|serialis|summaris|optimis"
    r"|minimis|maximis|quantis|catalogue|labelled|modelled|cancelled|judgement|artefact|licence|grey|centre|analyse",
    re.IGNORECASE,
)
ACCEPTED = {"colour", "colourimage"}  # names of folders that other people's captures have


def test_words_are_spelled_as_in_american_english():
    paths = [path for folder in ("pcdata", "benchmarks", "examples", "configs") for path in (ROOT / folder).rglob("*")]
    paths += [path for path in (ROOT / "tests").rglob("*.py") if path != Path(__file__)]
    paths += [*(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md")]
    found = {
        f"{path.relative_to(ROOT)}: {word}"
        for path in paths
        if path.suffix in {".py", ".md", ".yaml", ".cpp", ".hpp"}
        for line in path.read_text(encoding="utf-8").splitlines()
        if BRITISH.search(line)  # before the words are cut out: nearly no line has one
        for word in re.findall(r"\w+", line)
        if BRITISH.search(word) and word not in ACCEPTED
    }
    assert found == set()
