"""Text of any origin in Markdown: it shows as it is, and can become no heading, link, image, tag or table."""

from __future__ import annotations

import re
import unicodedata

# Every sign that Markdown or HTML could read, where it could: as an entity it is text in both.
_SIGNS = re.compile(
    r"[&<>`*\[\]|\\~$#!{}@]|(?<![0-9A-Za-z])_|_(?![0-9A-Za-z])|:(?=//)|(?<=www)\.|^[-+=]|^[0-9]+(?=[.)]\s)",
    re.IGNORECASE,
)
_LONGEST = 300


def as_markdown(text: object) -> str:
    """Return a text in one line of Markdown that shows it, signs that cannot be seen as ``U+200B``."""
    shown = str(text)
    if not shown.isprintable():
        shown = "".join(map(_visible, shown))
    shown = shown if len(shown) <= _LONGEST else f"{shown[:_LONGEST]}..."
    return _SIGNS.sub(lambda found: "".join(f"&#{ord(sign)};" for sign in found[0]), shown.strip()) or "(empty)"


def _visible(sign: str) -> str:
    if sign in "\t\n\r":
        return " "
    # Controls, marks that turn the direction of writing, lone surrogates: nobody sees what they do.
    return f"(U+{ord(sign):04X})" if unicodedata.category(sign) in ("Cc", "Cf", "Cs", "Zl", "Zp", "Co", "Cn") else sign
