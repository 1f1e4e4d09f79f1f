"""Captures as others recorded them: one protocol, one small file per layout."""
