"""Cameras and poses as files."""
