"""Text from files as a page may show it: never markup, never a control character."""

from __future__ import annotations

import html
import unicodedata

_LONGEST = 2000


def shown(text: object, longest: int = _LONGEST) -> str:
    """Return text for HTML: marks that change direction or cannot be seen as escapes, what is too long cut with a note.

    Lone surrogates, as Python makes of file names that are not UTF-8, become escapes too.
    """
    told = str(text)
    if len(told) > longest:
        told = f"{told[:longest]}... ({len(told):,} characters)"
    safe = "".join(c if _is_plain(c) else ascii(c)[1:-1] for c in told)
    return html.escape(safe, quote=True)


def _is_plain(character: str) -> bool:
    if character in "\n\t ":
        return True
    # Cc control, Cf format (direction marks, joiners), Cs surrogate, Zl and Zp line and paragraph separators.
    return unicodedata.category(character) not in ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp")


def plain(text: object, longest: int = 200) -> str:
    """Return the same for JSON, which the page's script sets as text."""
    return html.unescape(shown(text, longest))
