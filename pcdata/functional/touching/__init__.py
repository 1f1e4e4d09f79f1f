"""Touching objects told apart on a depth image, by geometry, and by color beside it."""

from pcdata.functional.touching.separation import REASONS, Separation, in_order_of_rows, separate_objects
from pcdata.functional.touching.views import View, separate_views

__all__ = ["REASONS", "Separation", "View", "in_order_of_rows", "separate_objects", "separate_views"]
