"""Numbers in plain text files, as people and other programs write them."""

from __future__ import annotations


def numbers_of(text: str) -> list[float]:
    """Return the numbers of a text, parted by white space or commas.

    Raises:
        ValueError: a word is no number.
    """
    return [number_of(word) for word in text.replace(",", " ").split()]


def number_of(word: str) -> float:
    """Return the number that a word is.

    Raises:
        ValueError: it is none.
    """
    try:
        if "_" not in word and word.isascii():  # float() takes 1_000 and the digits of other scripts
            return float(word)
    except ValueError:
        pass
    raise ValueError(f"{word[:60]!r} is no number")
