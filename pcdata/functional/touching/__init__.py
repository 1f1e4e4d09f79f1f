"""Touching objects told apart on a depth image, by geometry alone."""

from pcdata.functional.touching.separation import REASONS, Separation, in_order_of_rows, separate_objects

__all__ = ["REASONS", "Separation", "in_order_of_rows", "separate_objects"]
