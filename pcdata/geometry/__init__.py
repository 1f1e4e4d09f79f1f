"""Maths without clouds: rigid motions, lenses, planes, robust statistics."""
