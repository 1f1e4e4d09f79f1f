"""Depth, color, label and confidence images as files."""
