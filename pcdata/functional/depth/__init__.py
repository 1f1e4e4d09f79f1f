"""Depth images: to points and back, averaged, filled, resampled, registered to color."""
