"""Damage of the kinds that disks, transfers and strangers do: flipped bits, cut ends, other numbers, other words."""

from __future__ import annotations

import random
import re

NUMBERS = [
    0,
    1,
    2,
    127,
    128,
    255,
    256,
    32767,
    65535,
    65536,
    (1 << 31) - 1,
    1 << 31,
    (1 << 32) - 1,
    1 << 40,
    (1 << 63) - 1,
]
WORDS = [
    "-1", "0", "1e999", "nan", ".nan", "-inf", "9" * 5000, "''", "null", "true", "[]", "{}", "{a: " * 40, "[" * 3000,
    "&a", "*a", "!!int ''", "!!python/name:os.system", "\x00", "\x1b[2J", "../../etc/passwd", "é", "\ud7ff", "- ", ": ",
    "1,2,3", '"', "0x", "1_000", "2026-13-45", "1:2:3", "%s", "<<",
]  # fmt: skip


def mutant(data: bytes, number: random.Random) -> bytes:
    """Return damaged bytes: one to three edits, of bits, bytes, spans, number fields or words."""
    content = bytearray(data)
    text = not any(byte < 9 for byte in content[:512])
    for _ in range(number.choice((1, 1, 1, 2, 3))):
        if not content:
            break
        at = number.randrange(len(content))
        if number.random() < 0.5:  # heads hold what readers trust
            at = number.randrange(min(len(content), 512))
        edit = number.choice(("word", "word", "line", *_BYTES) if text else _BYTES)
        if edit == "bit":
            content[at] ^= 1 << number.randrange(8)
        elif edit == "byte":
            content[at] = number.choice((0, 255, number.randrange(256)))
        elif edit == "cut":
            del content[at:]
        elif edit == "extend":
            content += number.randbytes(number.randrange(1, 64))
        elif edit == "remove":
            del content[at : at + number.choice((1, 2, 4, 8, number.randrange(1, 200)))]
        elif edit == "double":
            span = content[at : at + number.choice((1, 4, 16, number.randrange(1, 500)))]
            content[at:at] = span
        elif edit == "move":
            span = content[at : at + number.randrange(1, 200)]
            to = number.randrange(len(content))
            content[to : to + len(span)] = span
        elif edit == "number":
            size = number.choice((1, 2, 4, 8))
            value = number.choice(NUMBERS) % (1 << 8 * size)
            content[at : at + size] = value.to_bytes(size, number.choice(("little", "big")))
        elif edit == "word":
            words = list(_WORD.finditer(content))
            if words:
                word = number.choice(words)
                content[word.start() : word.end()] = number.choice(WORDS).encode("utf-8", "surrogatepass")
        else:
            lines = content.split(b"\n")
            a, b = number.randrange(len(lines)), number.randrange(len(lines))
            change = number.choice(("swap", "double", "drop"))
            if change == "swap":
                lines[a], lines[b] = lines[b], lines[a]
            elif change == "double":
                lines.insert(a, lines[b])
            else:
                del lines[a]
            content = bytearray(b"\n".join(lines))
    return bytes(content)


_WORD = re.compile(rb"[^\s,:\[\]{}]+")
_BYTES = ("bit", "bit", "byte", "byte", "cut", "extend", "remove", "double", "move", "number", "number")
