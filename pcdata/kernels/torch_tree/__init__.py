"""Plain torch on any device, with a tree of boxes and cells instead of all pairs; see each module's sources."""

from __future__ import annotations

from pcdata.kernels.torch_tree import clusters as tree_clusters
from pcdata.kernels.torch_tree import outliers as tree_outliers
from pcdata.kernels.torch_tree import search as tree_search

__all__ = ["tree_clusters", "tree_outliers", "tree_search", "unavailable"]


def unavailable() -> None:
    """Return None: it needs torch alone."""
