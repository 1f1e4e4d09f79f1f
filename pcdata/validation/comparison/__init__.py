"""Two sources side by side: what differs, by how much, and which step closes it."""

from pcdata.validation.comparison.compare import compare_sources
from pcdata.validation.comparison.result import Comparison, Difference, Measured

__all__ = ["Comparison", "Difference", "Measured", "compare_sources"]
