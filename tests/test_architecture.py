"""The page on architecture names what is there: rooms, paths, and the order in which they may import."""

from __future__ import annotations

import re
from pathlib import Path

from tests.test_layering import LEVEL

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


def test_every_room_has_a_place_on_the_page():
    told = set(re.findall(r"\w+", PAGE))
    assert {room.removesuffix(".py") for room in LEVEL} - {
        "__main__",
        "threads",
        "yaml_nodes",
        "yaml_paths",
        "imports",
    } <= told


def test_the_order_of_imports_is_the_one_that_is_enforced():
    line = PAGE[PAGE.index("`errors` →") :].split("\n\n")[0]
    order = [room for part in re.findall(r"`([\w ]+)`", line) for room in part.split()]
    assert [LEVEL[room] for room in order] == sorted(LEVEL[room] for room in order)


def test_every_path_on_the_page_is_there():
    paths = [path for path in re.findall(r"`((?:pcdata|tests|docs)/[^`<]*?)(?:<[^`]*)?`", PAGE) if "cuda" not in path]
    assert len(paths) > 12
    assert [path for path in paths if not (ROOT / path).exists()] == []
