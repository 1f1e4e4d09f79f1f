"""The histories of stored clouds, which training carries along and seldom reads: parsed when somebody does."""

from __future__ import annotations

from typing import Any

from pcdata.errors import CacheError
from pcdata.files.strict_json import parse_json

Step = dict[str, Any]


class StoredSteps:
    """The steps of one cloud: those of a JSON text, a list, and then more."""

    __slots__ = ("_more", "_text")

    def __init__(self, text: bytes, more: tuple[Step, ...] = ()) -> None:
        self._text = text
        self._more = more

    def then(self, step: Step) -> StoredSteps:
        """Return the steps with one more."""
        return StoredSteps(self._text, (*self._more, step))

    def read(self) -> tuple[Step, ...]:
        """Return the steps.

        Raises:
            CacheError: the text is no JSON list.
        """
        try:
            stored = parse_json(self._text)
        except ValueError as error:
            raise CacheError(f"the history of a cloud is damaged: {error!s:.300}; rebuild the dataset") from error
        if not isinstance(stored, list):
            raise CacheError("the history of a cloud must be a list of steps; rebuild the dataset")
        return (*stored, *self._more)
