"""Words in figures.

matplotlib sets what stands between two dollars as a formula, and leaves out of legends what begins with an underscore.
"""

from __future__ import annotations


def label_text(text: str) -> str:
    """Return a name from a file as matplotlib is to show it: as it is written, control characters as escapes."""
    shown = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text).replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown
