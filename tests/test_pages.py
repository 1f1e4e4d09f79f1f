"""The Python that pages show: it parses, and what it imports from pcdata is there; that of some pages runs."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted([*(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md")])
RUN = ("fusion.md",)  # pages whose blocks, one after another, need nothing but pcdata


def python_blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_what_pages_import_is_there(page):
    for block in python_blocks(page):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "pcdata":
                module = importlib.import_module(node.module)
                missing = [one.name for one in node.names if not hasattr(module, one.name)]
                for name in missing:  # a module that nothing has loaded yet
                    importlib.import_module(f"{node.module}.{name}")


@pytest.mark.parametrize("name", RUN)
def test_pages_run(name):
    blocks = python_blocks(ROOT / "docs" / name)
    assert len(blocks) > 1
    exec(compile("\n".join(blocks), name, "exec"), {})
