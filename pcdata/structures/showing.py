"""Showing clouds and frames: what draws them is loaded by name when it is first asked for, as kernels are."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any


def shown_page(views: Sequence[tuple[str, Any]], title: str, **options: Any) -> Any:
    """Return a :class:`pcdata.report.Page` of captures and clouds, each with its caption."""
    return importlib.import_module("pcdata.report.page").page_of_views(views, title, **options)
