"""What the author of a transform is told where the class says one thing and does another."""

from __future__ import annotations

from typing import TYPE_CHECKING, NoReturn

from pcdata.errors import ConfigError
from pcdata.rng import Streams

if TYPE_CHECKING:
    from torch import Generator

_RANDOM_LINES = """\
    is_random = True
    def make_params(self, data, streams):
        return {"draw": streams.uniform(0.0, 1.0)}  # (B,), one number per cloud; transform reads params["draw"]"""


class UndeclaredStreams(Streams):
    """What a step that does not say ``is_random`` gets for its streams: any use of them tells its author so."""

    def __init__(self, step: str) -> None:
        self._step = step

    @property
    def generators(self) -> list[Generator]:  # type: ignore[override]
        """Every method of :class:`Streams` draws from these."""
        self._refuse()

    def _refuse(self) -> NoReturn:
        raise ConfigError(
            f"{self._step} draws from its streams but does not say that it is random; write into the class:\n"
            f"{_RANDOM_LINES}"
        )
