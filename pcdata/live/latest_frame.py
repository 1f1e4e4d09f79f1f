"""The newest frame of a camera, handed from its thread to the one that works: old ones are dropped and counted."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from pcdata.errors import ConfigError
from pcdata.live.faults import StalledError

_JOIN = 1.0  # seconds that closing waits for a read to return


class Arrived(NamedTuple):
    """A frame as the camera gave it."""

    item: Any
    stamp: float  # seconds: of the camera where it told one, else when it arrived, by the clock
    number: int  # of the frame, counted from 0; numbers that are left out were dropped


class LatestFrame:
    """Holds one frame, the newest: a camera puts, in its own thread; a pipeline takes, each frame once.

    Where the camera is faster, frames in between are dropped and counted; where it is slower, the taker waits. A frame
    that lay for longer than ``max_age`` is dropped too, so a camera that stands still is told, and its last frame never
    served as new. No frame but the one held, and the one being put, is kept.

    Args:
        timeout: seconds without a new frame after which :meth:`take` says that the camera stalled.
        max_age: seconds that a frame may wait to be taken; None = any.
        clock: returns seconds; also the clock of a camera's own stamps.

    Raises:
        ConfigError: a timeout or an age that is not above 0.
    """

    def __init__(
        self, *, timeout: float = 1.0, max_age: float | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        for name, value in (("timeout", timeout), ("max_age", max_age)):
            if value is not None and not value > 0:
                raise ConfigError(f"LatestFrame: {name} must be above 0 seconds, got {value!r}")
        self.timeout, self.max_age, self.clock = timeout, max_age, clock
        self._changed = threading.Condition()
        self._held: tuple[Arrived, float] | None = None  # and when it was put, by the monotonic clock
        self._given = self._dropped = 0
        self._error: BaseException | None = None
        self._ended = False
        self._thread: threading.Thread | None = None

    @classmethod
    def reading(cls, read: Callable[[], Any], **options: Any) -> LatestFrame:
        """Start a thread that calls ``read`` for one frame after another, and return what holds the newest.

        ``read`` blocks until there is a frame; None means that there was none. It ends the stream by StopIteration;
        whatever else it raises is raised by :meth:`take`, once.
        """
        camera = cls(**options)
        camera._thread = threading.Thread(target=camera._read, args=(read,), name="pcdata camera", daemon=True)
        camera._thread.start()
        return camera

    def _read(self, read: Callable[[], Any]) -> None:
        try:
            while not self._ended:
                item = read()
                if item is not None:
                    self.put(item)
        except StopIteration:
            pass
        except BaseException as error:  # whatever it is, it is told where the frames are taken
            self._error = error
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def put(self, item: Any, stamp: float | None = None) -> None:
        """Hold a frame instead of the one before; called by the camera, from any thread."""
        arrived = Arrived(item, self.clock() if stamp is None else stamp, self._given)
        with self._changed:
            if self._ended:
                return
            self._dropped += self._held is not None
            self._held = arrived._replace(number=self._given), time.monotonic()
            self._given += 1
            self._changed.notify()

    def take(self, timeout: float | None = None) -> Arrived:
        """Wait for a frame that was not taken yet, and return it.

        Args:
            timeout: seconds; None = the one given at the start.

        Raises:
            StalledError: no frame came in time.
            StopIteration: the camera ended the stream, or this was closed.
            Exception: what the camera's thread raised.
        """
        until = time.monotonic() + (self.timeout if timeout is None else timeout)
        with self._changed:
            while True:
                if self._held is not None:
                    (arrived, since), self._held = self._held, None
                    if self.max_age is None or time.monotonic() - since <= self.max_age:
                        return arrived
                    self._dropped += 1
                if self._error is not None:
                    error, self._error = self._error, None
                    raise error
                if self._ended:
                    raise StopIteration
                left = until - time.monotonic()
                if left <= 0:
                    waited = self.timeout if timeout is None else timeout
                    raise StalledError(
                        f"LatestFrame: no new frame for {waited:g} s, after {self._given} frames; is the camera "
                        "connected, and does its thread still run?"
                    )
                self._changed.wait(left)

    @property
    def dropped(self) -> int:
        """How many frames nobody took."""
        with self._changed:
            return self._dropped

    @property
    def given(self) -> int:
        """How many frames the camera gave."""
        with self._changed:
            return self._given

    def close(self) -> None:
        """End the stream, and wait up to a second for the camera's thread."""
        with self._changed:
            self._ended, self._held = True, None
            self._changed.notify_all()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_JOIN)

    def __iter__(self) -> Iterator[Arrived]:
        """Yield every frame that is taken, until the stream ends; raise as :meth:`take` does."""
        while True:
            try:
                arrived = self.take()
            except StopIteration:
                return
            yield arrived

    def __enter__(self) -> LatestFrame:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
