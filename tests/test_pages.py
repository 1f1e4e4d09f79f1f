"""Every page is found: links lead from the README to all of docs/, and none leads nowhere."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def linked(page: Path) -> set[Path]:
    """The files and folders of this project that a page links to; a folder is the README in it."""
    found = set()
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if not re.match(r"[a-z]+:", target):
            path = (page.parent / target).resolve()
            found.add(path / "README.md" if (path / "README.md").is_file() else path)
    return found


def test_every_link_to_a_file_leads_somewhere() -> None:
    lost = [f"{page.relative_to(ROOT)}: {path}" for page in PAGES for path in linked(page) if not path.exists()]
    assert not lost


def test_every_page_is_reached_from_the_readme() -> None:
    reached, ahead = set(), [ROOT / "README.md"]
    while ahead:
        page = ahead.pop()
        if page not in reached:
            reached.add(page)
            ahead += [path for path in linked(page) if path.suffix == ".md" and path.is_file()]
    assert [str(page.relative_to(ROOT)) for page in PAGES if page not in reached] == []


def test_the_list_of_pages_has_every_page_of_its_folder() -> None:
    folder = ROOT / "docs"
    assert set(folder.glob("*.md")) - linked(folder / "README.md") == {folder / "README.md"}
