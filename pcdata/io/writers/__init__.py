"""Captures written for others to read."""
