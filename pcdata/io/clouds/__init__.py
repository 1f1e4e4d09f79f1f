"""Clouds as files: PCD and PLY."""
