"""Bytes that are kept for a while: the last ones, within a limit."""

from __future__ import annotations

from pcdata.files.recent import Recent


def test_what_was_used_last_is_kept_within_the_limit() -> None:
    made: list[str] = []

    def make(name: str, size: int = 4) -> bytes:
        made.append(name)
        return name.encode() * size

    recent = Recent(10)
    for name in "abab":
        assert recent.get(name, lambda name=name: make(name)) == name.encode() * 4
    assert made == ["a", "b"]
    recent.get("a", lambda: make("a"))
    recent.get("c", lambda: make("c"))  # b was used longest ago
    recent.get("a", lambda: make("a"))
    recent.get("b", lambda: make("b"))
    assert made == ["a", "b", "c", "b"]


def test_one_that_is_larger_than_the_limit_is_kept_alone() -> None:
    recent = Recent(10)
    recent.get("a", lambda: b"a")
    recent.get("large", lambda: bytes(100))
    assert len(recent.get("large", lambda: b"made again")) == 100
    assert recent.get("a", lambda: b"made again") == b"made again"
    assert recent.get("large", lambda: b"made again") == b"made again"


def test_many_small_ones_are_dropped_too() -> None:
    recent = Recent(1 << 20)
    for number in range(1000):
        recent.get(number, lambda: b"x")
    assert recent.get(999, lambda: b"again") == b"x"
    assert recent.get(0, lambda: b"again") == b"again"
