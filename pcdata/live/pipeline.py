"""LivePipeline: a chain on a camera's stream."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from os import PathLike
from pathlib import Path
from threading import Lock
from typing import Any

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from pcdata.build import load_config
from pcdata.errors import (
    CaptureError,
    DTypeError,
    FrameError,
    IntrinsicsError,
    NonFiniteError,
    PoseError,
    ShapeError,
)
from pcdata.functional.depth.looks import look_at_depth
from pcdata.live.arrays import ArrayReader
from pcdata.live.chain_runs import ChainRuns
from pcdata.live.faults import Fault, LiveResult, StalledError
from pcdata.live.first_frame import check_like, has_readings
from pcdata.live.kept_memory import keep_freed_memory
from pcdata.live.latency import Histogram
from pcdata.live.latest_frame import LatestFrame
from pcdata.live.over_time import OverTime
from pcdata.live.stamps import Stamps
from pcdata.live.stats import LiveStats
from pcdata.structures import DepthFrame, PointCloud
from pcdata.structures.structure import with_tensors
from pcdata.threads import torch_on_one_thread
from pcdata.transforms import Compose

_KINDS: tuple[tuple[type[Exception], Fault], ...] = (  # of what making a frame raises; the first that fits
    (IntrinsicsError, Fault.OTHER_CAMERA),
    (FrameError, Fault.OTHER_CAMERA),
    (PoseError, Fault.BAD_VALUES),
    (NonFiniteError, Fault.BAD_VALUES),
    (CaptureError, Fault.BAD_VALUES),
    (ShapeError, Fault.OTHER_FORM),
    (DTypeError, Fault.OTHER_FORM),
)


class LivePipeline:
    """Runs a chain on the frames of one camera, one after another; what is wrong with a frame is told, never raised.

    The chain is the one that built the dataset, as an object or as the file that it is written in, and each cloud is
    bit for bit the one that it gives offline. A cloud belongs to the caller: memory that is used again is the
    pipeline's own (the frames' depth and colors where they come as arrays, scratch in the core). Every frame must be
    like the first in size, dtype, camera and images; what the first has shown is not looked at again. Torch runs on the
    calling thread alone, the compiled core on all of torch's threads: give torch the cores that are free.

    Args:
        chain: from captures to clouds; or the path of its YAML, alone or within a configuration of a build.
        like: the first frame, or one like it. The chain runs on it once, so what is wrong with the chain is raised
            here, and the frames find memory and caches warm.
        max_age: seconds from a frame's stamp beyond which it is too late to look at; None = never.
        clock: the clock of the stamps, in seconds: ``time.monotonic`` for frames stamped where they arrive,
            ``time.time`` or a node's clock for stamps of a driver.
        before: a :class:`LiveTemporalFilter` or :class:`LiveAverage` that frames go through before the chain.
        invalid_values: stored numbers of arrays besides 0 that mean "no reading".
        same_pixels: whether a frame equal to the one before in every depth pixel is frozen. No sensor gives one; a
            simulator without noise does.
        warm_planes: let RemovePlane score the plane of the frame before first. A wrong one loses, and a good one is
            refined in fewer rounds; but what is found is no longer bit for bit what the chain finds offline. Nothing
            changes where a GPU has captured the step.
        seed: needed where steps are random: each frame is drawn for anew with it.

    Raises:
        ConfigError: the chain gives no clouds, or is random and there is no seed.
        PcdataError: the chain refuses the first frame.
    """

    def __init__(
        self,
        chain: Compose | str | PathLike[str],
        *,
        like: DepthFrame,
        max_age: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        before: OverTime | None = None,
        invalid_values: Collection[int] = (),
        same_pixels: bool = True,
        warm_planes: bool = False,
        seed: int | None = None,
    ) -> None:
        self.chain = _chain_of(chain)
        if not isinstance(like, DepthFrame):
            raise DTypeError(
                f"LivePipeline: like must be a DepthFrame, got {type(like).__name__}; of arrays make one by "
                "DepthFrame.from_numpy(depth, intrinsics, metres_per_unit=0.001)"
            )
        if before is not None and not isinstance(before, OverTime):
            raise DTypeError(
                f"LivePipeline: before must be a LiveTemporalFilter or a LiveAverage, got {type(before).__name__}"
            )
        keep_freed_memory()
        self.before, self.max_age = before, max_age
        self._like, self._same_pixels = like, same_pixels
        self._arrays = ArrayReader(like, like.provenance.get("metres_per_unit"), invalid_values)
        self._stamps = Stamps(max_age, clock)
        self._camera: LatestFrame | None = None
        self._last: Tensor | None = None
        self._copies: list[Tensor] = []  # two at most, used in turns
        self._turn = Lock()  # held while a frame is worked on
        self._number = 0
        self._runs = ChainRuns(self.chain, like, seed=seed, warm_planes=warm_planes)
        self._is_captured = bool(self._runs.captured)
        self.reset_stats()

    def __call__(
        self,
        frame: DepthFrame | ArrayLike,
        *,
        stamp: float | None = None,
        colors: ArrayLike | None = None,
        confidence: ArrayLike | None = None,
        pose: ArrayLike | None = None,
    ) -> LiveResult:
        """Answer one frame by a cloud or by a named fault; nothing about the frame is raised.

        Args:
            frame: a capture; or its depth, (H, W) or (V, H, W), as ``DepthFrame.from_numpy`` made the first of it.
            stamp: seconds when it was taken; without stamps nothing is late or out of order.
            colors: beside an array: (H, W, 3) or (V, H, W, 3) uint8 RGB, if the first frame has colors.
            confidence: beside an array: uint8, values of Confidence.
            pose: beside an array: world_from_camera, if the first frame has it.
        """
        with self._turn, torch_on_one_thread():  # a thread of torch's own would wait for more, at the core's expense
            started = time.perf_counter()
            number, self._number = self._number, self._number + 1
            cloud, fault, reason = None, *self._stamps.check(stamp)
            if fault is None:
                cloud, fault, reason = self._answer(frame, stamp, colors, confidence, pose)
            seconds = time.perf_counter() - started
            if fault is None:
                self._whole.add(seconds)
            else:
                self._faults[str(fault)] += 1
            return LiveResult(
                cloud=cloud,
                fault=fault,
                reason=reason,
                stamp=stamp,
                age=self._stamps.age(stamp),
                seconds=seconds,
                number=number,
            )

    def _answer(
        self, given: Any, stamp: float | None, colors: Any, confidence: Any, pose: Any
    ) -> tuple[PointCloud | None, Fault | None, str]:
        try:
            if isinstance(given, DepthFrame):
                if colors is not None or confidence is not None or pose is not None:
                    raise ShapeError("LivePipeline: a DepthFrame has its own colors, confidence and poses")
                check_like(given, self._like)
                frame = given
            else:
                frame = self._arrays.frame(given, colors, confidence, pose, keep=self._last)
            seen = self._runs.look(frame) if self._is_captured and self.before is None else None
            # Nobody else writes to depth that was made of an array.
            copy = self._room_for_copy(frame.depth) if self._same_pixels and seen is None and frame is given else None
            looked = seen or look_at_depth(frame.depth, self._last if self._same_pixels else None, copy)
            is_empty = not has_readings(looked.least, looked.largest)
        except Exception as error:
            fault = next((fault for kind, fault in _KINDS if isinstance(error, kind)), Fault.OTHER_FORM)
            return None, fault, str(error)
        if is_empty:
            return None, Fault.EMPTY, "LivePipeline: not one pixel has a reading; is the lens covered?"
        if self._same_pixels and looked.is_same:
            return None, Fault.FROZEN, "LivePipeline: every pixel is that of the frame before; does the camera stream?"
        if self._same_pixels and seen is None:
            self._last = frame.depth if copy is None else copy  # what the next frame is held to
        try:
            if self.before is not None:
                since = time.perf_counter()
                frame = self.before(frame, stamp)
                self._runs.count(type(self.before).__name__, time.perf_counter() - since)
            cloud = self._runs.run(frame, seen)
        except NonFiniteError as error:
            return None, Fault.BAD_VALUES, str(error)
        except Exception as error:
            notes = getattr(error, "__notes__", [])
            return None, Fault.FAILED_STEP, "; ".join([str(error) or repr(error), *notes])
        if frame is not given:
            self._arrays.give_away(_tensors_of(cloud))
        return cloud, None, ""

    def _room_for_copy(self, depth: Tensor) -> Tensor:
        """Return memory for depth that does not hold the frame before."""
        for room in self._copies:
            if room is not self._last:
                return room
        self._copies.append(torch.empty_like(depth, memory_format=torch.contiguous_format, requires_grad=False))
        return self._copies[-1]

    def follow(self, camera: LatestFrame) -> Iterator[LiveResult]:
        """Answer the newest frame of a camera, again and again, until it ends the stream.

        A camera puts captures, depth arrays, or mappings of what a call takes: ``{"frame": depth, "colors": rgb}``. A
        frame without a stamp of its own has that of its arrival. Where no frame comes within the camera's timeout, a
        result with the fault ``stalled`` is given, and it goes on waiting.

        Raises:
            Exception: what the camera's thread raised.
        """
        self._camera = camera
        while True:
            try:
                arrived = camera.take()
            except StopIteration:
                return
            except StalledError as error:
                with self._turn:
                    self._faults[str(Fault.STALLED)] += 1
                yield LiveResult(fault=Fault.STALLED, reason=str(error), number=self._number)
                continue
            item = arrived.item
            given = dict(item) if isinstance(item, Mapping) else {"frame": item}
            del item
            yield self(**{"stamp": arrived.stamp, **given})

    def reset(self) -> None:
        """Forget the frames before: their stamps, their pixels, what filters gathered. The counts stay."""
        with self._turn:
            self._stamps.reset()
            self._last = None
            self._runs.forget()
            if self.before is not None:
                self.before.reset()

    def reset_stats(self) -> None:
        """Begin to count anew."""
        self._whole = Histogram()
        self._runs.reset_stats()
        self._faults: Counter[str] = Counter()
        self._counted_from = self._number
        self._dropped_before = 0 if self._camera is None else self._camera.dropped

    def stats(self) -> LiveStats:
        """Return what was counted since the start, or since :meth:`reset_stats`."""
        whole = self._whole.summary()
        return LiveStats(
            captured=self.captured,
            frames=self._number - self._counted_from,
            clouds=whole.count,
            faults=dict(self._faults),
            dropped=0 if self._camera is None else self._camera.dropped - self._dropped_before,
            restarts=self._stamps.restarts,
            resets=0 if self.before is None else self.before.resets,
            latency={"whole": whole, **self._runs.latency()},
        )

    @property
    def captured(self) -> tuple[str, ...]:
        """The steps from the first on that a GPU repeats for each frame as one CUDA graph; those behind run as ever."""
        return self._runs.captured

    def histogram(self) -> dict[str, list[float]]:
        """Return the latencies of whole frames: ``seconds``, the upper ends of the bins, and ``count`` of each."""
        return self._whole.bins()

    def __repr__(self) -> str:
        height, width = self._like.size
        return f"LivePipeline({len(self._runs)} steps, {self._like.num_views} views of {width}x{height})"


def _chain_of(given: Any) -> Compose:
    if isinstance(given, Compose):
        return given
    if isinstance(given, str | PathLike):
        return load_config(Path(given)).pipeline
    raise DTypeError(
        f"LivePipeline: the chain must be a Compose or the path of a YAML file, got {type(given).__name__}; of what "
        "load_config returns give .pipeline, of a list of steps make a Compose"
    )


def _tensors_of(cloud: PointCloud) -> list[Tensor]:
    found: list[Tensor] = []

    def note(tensor: Tensor) -> Tensor:
        found.append(tensor)
        return tensor

    with_tensors(cloud, note)
    return found
