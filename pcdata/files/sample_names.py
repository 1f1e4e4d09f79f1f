"""The order of sample names, and which of them can be told apart: one answer for every layout and every list."""

from __future__ import annotations

import itertools
import os
import re
import unicodedata
from collections.abc import Collection, Iterable, Sequence
from decimal import Decimal

from pcdata.errors import CaptureError, near_matches

_SHOWN = 5  # names in a message before "and n more"
_LONGEST = 200  # characters of a name in a message
# A minus belongs to a number at the start of a name and after one of "_ =": "t_-5"; elsewhere a dash divides, as in
# "frame-000840" and "2024-01-02". A point is a decimal one only where the number is the whole name, "1305031102.175",
# and no two names are one number then: "1.1" and "1.10" are counted, as in scene 1, frames 1 and 10.
_DECIMAL = re.compile(r"-?[0-9]+\.[0-9]+")
_PART = re.compile(r"((?:(?<![^_ =])-)?[0-9]+)")
_LAST = re.compile(r"[0-9]+\Z")
_CONTROLS = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029]")  # and separators of lines
_HEX = re.compile(r"[0-9a-f]+|[0-9A-F]+")
_DIGITS = "0123456789"
# A name with its digits, what makes a minus one, and everything else made alike.
_SHAPES = {code: "0" if chr(code) in _DIGITS else "_" if chr(code) in "_ =" else "x" for code in range(128)}
_SHAPES[ord("-")] = "-"
_MINUS = re.compile(r"(^|_)-0")
_MAX_POSITION = 10**18  # what fits into 64 bits

_Token = tuple[int, int | Decimal, str]  # numbers before texts
_Key = tuple[_Token, ...]


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: "1 capture", "2,000 captures"."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def in_order(names: Iterable[str]) -> list[str]:
    """Sort names as a person counts: 2 before 10, ``frame_2_left`` before ``frame_10_left``; ties by the text.

    Numbers are compared by value, whatever their length and leading zeros, one after another where a name has several.
    Names that count in hexadecimal digits (``9, a, 10``, or all of one length) stand in that order.
    """
    names = list(names)
    if _stand_in_text_order(names):
        return sorted(names)
    keys = _keys(names)
    return sorted(sorted(names), key=keys.__getitem__)


def positions(names: Sequence[str]) -> dict[str, int]:
    """Return the position of every name in the sequence.

    That is the number the names end in where they are alike before it, else the place in order.
    """
    if _stand_in_text_order(names) and not _DECIMAL.fullmatch(names[0]):
        last = _LAST.search(names[0])
        before = names[0][: last.start()] if last else ""
        counted = last and len(last[0]) <= 18 and _hex_prefix(names) is None
        if counted and all(name.startswith(before) for name in names):
            return {name: int(name[len(before) :]) for name in names}
        return {name: place for place, name in enumerate(sorted(names))}
    keys = _keys(names)
    alike = len({key[:-1] for key in keys.values()}) == 1 and _hex_prefix(names) is None
    if alike and all(key and _is_position(key[-1]) for key in keys.values()):
        return {name: int(keys[name][-1][1]) for name in names}
    return {name: place for place, name in enumerate(in_order(names))}


def in_order_of_last_number(names: Iterable[str]) -> list[str]:
    """Sort names by the number that they end in if all do, those of one number as :func:`in_order`; else as that."""
    ordered = in_order(names)
    ends = {name: match for name in ordered if (match := _LAST.search(name))}
    return sorted(ordered, key=lambda name: Decimal(ends[name][0])) if len(ends) == len(ordered) else ordered


def check_names(where: str, names: Iterable[str]) -> None:
    """Require names that can be stored, shown and told apart.

    Raises:
        CaptureError: a name is no UTF-8 text in one line, or two differ only in leading zeros or in how Unicode writes
            a letter.
    """
    names = list(names)
    check_text(where, names)
    if _stand_in_text_order(names):  # then no two are one
        return
    seen: dict[_Key, str] = {}
    for name, key in _keys(names).items():
        if key in seen:
            raise CaptureError(
                f"{where}: {seen[key]!r} and {name!r} are one name written in two ways ({_difference(seen[key], name)})"
                ", so their order is not certain; rename or remove one"
            )
        seen[key] = name


def check_text(where: str, names: Iterable[str]) -> None:
    """Require texts of UTF-8 in one line, which every list of names and every message takes for granted.

    Raises:
        CaptureError: a file or folder has a name of other bytes, which Python holds as lone surrogates, or one with
            control characters: what follows a line feed reads as a line of ours.
    """
    names = list(names)
    controlling = [name for name in names if _CONTROLS.search(name)]
    if controlling:
        shown = ", ".join(ascii(name[:_LONGEST]) for name in controlling[:_SHOWN])
        raise CaptureError(f"{where}: names must not have control characters: rename {shown}{_more(controlling)}")
    broken = [name for name in names if not _is_utf8(name)]
    if broken:
        shown = ", ".join(str(os.fsencode(name)) if _from_bytes(name) else ascii(name) for name in broken[:_SHOWN])
        raise CaptureError(
            f"{where}: names must be UTF-8 text, but {shown}{_more(broken)} {'is' if len(broken) == 1 else 'are'} not: "
            "what is built from them could not be read back; rename, such as with convmv or in a file manager"
        )


def check_known(where: str, sample_id: str, known: Collection[str], told: str = "") -> None:
    """Require the id of a sample that is there.

    Args:
        where: what has the samples, for the message.
        sample_id: the id.
        known: the ids that there are; of a long list pass what answers ``in`` at once.
        told: what the reader should know of these ids, such as "; a group is called after its first capture".

    Raises:
        CaptureError: names those nearest to it.
    """
    if sample_id not in known:
        raise CaptureError(f"{where}: no sample {sample_id!r:.{_LONGEST}}{told}{near_matches(str(sample_id), known)}")


def name_some(names: Iterable[str]) -> str:
    """Return the first few names in order and how many more there are."""
    listed = in_order(names)
    return ", ".join(name if len(name) <= _LONGEST else f"{name[:_LONGEST]}..." for name in listed[:_SHOWN]) + _more(
        listed
    )


def same_but_for_writing(missing: Iterable[str], spare: Iterable[str]) -> str:
    """Say in words that names without a partner have one that is written in another way; "" if not."""
    spare, missing = list(spare), list(missing)
    keys = _keys([*spare, *missing])
    partner = {keys[name]: name for name in spare}
    for name in missing:
        other = partner.get(keys[name], name)
        if other != name:
            return f"; {name!r} and {other!r} are written in two ways ({_difference(name, other)}): rename one of them"
    return ""


def _keys(names: Sequence[str]) -> dict[str, _Key]:
    """Return what names are sorted by; two with equal keys are one name in two ways of writing."""
    prefix = _hex_prefix(names)
    if prefix is not None:
        return {name: (_text(prefix), _number(int(name[len(prefix) :], 16))) for name in names}
    decimals = {name: Decimal(name) for name in {*names} if _DECIMAL.fullmatch(name)}
    if len(set(decimals.values())) < len(decimals):
        decimals = {}
    tokens = _Tokens()
    return {name: ((0, decimals[name], ""),) if name in decimals else tokens.of(name) for name in names}


def _stand_in_text_order(names: Sequence[str]) -> bool:
    """Say whether all names have digits at the same places, so that the order of the text is that of the numbers.

    That is so for padded names, of which there may be hundreds of thousands: their keys take a hundred times as long.
    Hexadecimal and decimal numbers of one length stand in the order of their text too.
    """
    if not names or not all(map(str.isascii, names)):  # Unicode writes some letters in two ways
        return False
    shape = names[0].translate(_SHAPES)
    return not _MINUS.search(shape) and all(name.translate(_SHAPES) == shape for name in names)


class _Tokens(dict[str, _Token]):
    """Numbers and texts by how they are written; most names of a capture share all but one."""

    def of(self, name: str) -> _Key:
        """Return what a name consists of."""
        parts = _PART.split(name if name.isascii() else unicodedata.normalize("NFC", name))
        return tuple(map(self.__getitem__, filter(None, parts)))

    def __missing__(self, part: str) -> _Token:
        token = self[part] = _number(part) if part[-1] in _DIGITS else _text(part)
        return token


def _number(digits: str | int) -> _Token:
    # Both are exact for any number of digits; Python refuses to read very long whole numbers, and they are faster.
    return 0, int(digits) if len(str(digits)) < 100 else Decimal(digits), ""


def _text(text: str) -> _Token:
    return 1, 0, text


def _hex_prefix(names: Sequence[str]) -> str | None:
    """Return what stands before the hexadecimal numbers that all names end in; None if they do not count so."""
    first, last = min(names, default=""), max(names, default="")
    alike = itertools.takewhile(lambda pair: pair[0] == pair[1], zip(first, last))
    prefix = "".join(letter for letter, _ in alike).rstrip("0123456789abcdefABCDEF")
    return prefix if _count_in_hex([name[len(prefix) :] for name in names]) else None


def _count_in_hex(ends: Sequence[str]) -> bool:
    """Say whether these are hexadecimal numbers: of one length, or counted on from digits to letters."""
    text = "".join(ends)
    if not ends or not _HEX.fullmatch(text) or not all(ends) or text.isdecimal() or text.isalpha():
        return False
    return len(set(map(len, ends))) == 1 or (
        any(end.isdecimal() for end in ends) and any(end[0].isalpha() for end in ends)
    )


def _is_position(token: _Token) -> bool:
    kind, number, _ = token
    return kind == 0 and 0 <= number < _MAX_POSITION and number == int(number)


def _difference(first: str, second: str) -> str:
    alike = unicodedata.normalize("NFC", first) == unicodedata.normalize("NFC", second)
    return f"Unicode: {first!a} and {second!a}" if alike else "zeros that do not count"


def _is_utf8(name: str) -> bool:
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True


def _from_bytes(name: str) -> bool:
    try:
        os.fsencode(name)
    except UnicodeEncodeError:
        return False
    return True


def _more(names: Sequence[str]) -> str:
    return f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
