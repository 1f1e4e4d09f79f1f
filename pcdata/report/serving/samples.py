"""Samples as the viewer asks for them: read one at a time, the last ones kept, in bounded memory."""

from __future__ import annotations

import sys
import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

from pcdata.errors import OutOfRangeError, PcdataError, is_out_of_memory
from pcdata.io.sources.capture_source import CaptureSource
from pcdata.report.html.gathering import Looked, look
from pcdata.report.html.page import scene_json
from pcdata.report.html.pictures import png_uri
from pcdata.report.html.text import plain
from pcdata.transforms import Compose
from pcdata.verdicts import finite_json

MOST_LISTED = 200  # names in one answer
_LAST_WAIT = 30.0  # seconds
_MOST_KEPT = 256 << 20  # bytes of samples that were looked at


@dataclass(frozen=True)
class _Sample:
    description: dict[str, Any]
    clouds: tuple[bytes, ...]
    size: int  # bytes, about


class Samples:
    """The samples of a source for many threads.

    Sources are made for one thread: a lock lets one read and pack at a time, while others send what is kept.

    Args:
        source: anything with ``ids`` and ``load``.
        pipeline: steps whose clouds are shown; None = the cloud that each capture shows.
        most_kept: bytes of samples in memory; at least the last is kept.
    """

    def __init__(self, source: CaptureSource, pipeline: Compose | None = None, *, most_kept: int = _MOST_KEPT) -> None:
        self.ids = source.ids
        self._source = source
        self._pipeline = pipeline
        self._most_kept = most_kept
        self._reading = threading.Lock()
        self._keeping = threading.Lock()
        self._closed = False
        self._kept: OrderedDict[int, _Sample] = OrderedDict()

    def __len__(self) -> int:
        return len(self.ids)

    def names(self, first: int, text: str) -> dict[str, Any]:
        """Return up to :data:`MOST_LISTED` samples whose ids hold a text, from the ``first``-th of them on."""
        folded = text.casefold()
        if folded:
            fits: Any = [place for place, sample_id in enumerate(self.ids) if folded in sample_id.casefold()]
        else:
            fits = range(len(self.ids))
        first = min(first, max(len(fits) - 1, 0)) // MOST_LISTED * MOST_LISTED
        listed = [[place, plain(self.ids[place], 120)] for place in fits[first : first + MOST_LISTED]]
        return {"total": len(self.ids), "matching": len(fits), "from": first, "samples": listed}

    def description(self, place: int) -> dict[str, Any]:
        """Return what the viewer shows of a sample, all but the points.

        Raises:
            OutOfRangeError: there is no such sample.
        """
        return self._sample(place).description

    def cloud(self, place: int, stage: int) -> bytes:
        """Return the packed points of one stage of a sample.

        Raises:
            OutOfRangeError: there is no such sample or stage.
        """
        clouds = self._sample(place).clouds
        if not 0 <= stage < len(clouds):
            raise OutOfRangeError(f"view: sample {place} has {len(clouds)} stages, not a stage {stage}")
        return clouds[stage]

    def close(self) -> None:
        """Read no more, and wait for what is read now: a process must not end in the middle of it."""
        self._closed = True
        if self._reading.acquire(timeout=_LAST_WAIT):
            self._reading.release()

    def _sample(self, place: int) -> _Sample:
        if not 0 <= place < len(self.ids):
            raise OutOfRangeError(f"view: there are {len(self.ids)} samples, none with the number {place}")
        if (kept := self._recall(place)) is not None:
            return kept
        with self._reading:
            if self._closed:
                raise OutOfRangeError("view: it has ended")
            if (kept := self._recall(place)) is not None:  # another thread has read it meanwhile
                return kept
            made = _packed(place, self._look(place))
            with self._keeping:
                self._kept[place] = made
                total = sum(one.size for one in self._kept.values())
                while total > self._most_kept and len(self._kept) > 1:
                    total -= self._kept.popitem(last=False)[1].size
            return made

    def _recall(self, place: int) -> _Sample | None:
        with self._keeping:
            if place in self._kept:
                self._kept.move_to_end(place)
            return self._kept.get(place)

    def _look(self, place: int) -> Looked:
        try:
            return look(self._source, place, pipeline=self._pipeline)
        except PcdataError as error:
            problem = str(error)
        except Exception as error:  # one sample that breaks a reader or step of the user's own must not end the view
            problem = "not enough memory" if is_out_of_memory(error) else f"{type(error).__name__}: {error}"
            print(f"view: {self.ids[place]!r}: {problem}", file=sys.stderr)
        return Looked(self.ids[place], None, (), (), problem)


def _packed(place: int, looked: Looked) -> _Sample:
    stages = looked.scene.stages if looked.scene is not None else ()
    blobs = [f"cloud/{place}/{stage}" for stage in range(len(stages))]
    said = scene_json(looked.scene, blobs) if looked.scene is not None else {"stages": []}
    pictures = [{"caption": plain(one.caption), "uri": png_uri(one.png)} for one in looked.pictures]
    description = {
        **said,
        "name": plain(looked.sample_id, 120),
        "problem": plain(looked.problem, 2000),
        "pictures": pictures,
    }
    clouds = tuple(stage.cloud.content for stage in stages)
    lines = sum(line.segments.size * 32 for stage in stages for line in stage.lines)
    size = sum(map(len, clouds)) + sum(len(one["uri"]) for one in pictures) + lines + 4096
    return _Sample(finite_json(description), clouds, size)
