"""The tree of frames that tf describes, and the way from one frame to another at a time.

Source: tf2: a transform is the pose of the child frame in its parent; one that moves is interpolated, one that is
static holds for ever.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.errors import CaptureError
from pcdata.geometry import rigid
from pcdata.io.messages.clock import lateness
from pcdata.io.messages.decoding import stamp
from pcdata.io.sources.synchronized import Trajectory, joined

Edge = tuple[str, str]  # parent, child


class FrameTree:
    """Frames and the poses that lead from each to its parent, over time; times are nanoseconds."""

    def __init__(self, where: str, moving: Mapping[Edge, Trajectory], static: Mapping[Edge, Tensor]) -> None:
        self._where, self._moving, self._static = where, dict(moving), dict(static)
        parents: dict[str, str] = {}
        for parent, child in (*self._moving, *self._static):
            if parents.setdefault(child, parent) != parent:
                raise CaptureError(
                    f"{where}: tf gives the frame {child!r} two parents, {parents[child]!r} and {parent!r}; a frame "
                    "has one"
                )
        self._parents = parents
        self._check_circles()

    @property
    def frames(self) -> list[str]:
        """The names of all frames, sorted."""
        return sorted({*self._parents, *self._parents.values()})

    @property
    def edges(self) -> set[Edge]:
        """The pairs of parent and child."""
        return {*self._moving, *self._static}

    def _check_circles(self) -> None:
        ends: set[str] = set()  # frames from which the way to a root is known
        for frame in self._parents:
            way: dict[str, None] = {}
            while frame in self._parents and frame not in ends:
                if frame in way:
                    circle = [*[*way][[*way].index(frame) :][:20], frame]
                    raise CaptureError(
                        f"{self._where}: tf goes in a circle, {' in '.join(map(repr, circle))}; which pose "
                        "is right cannot be known: record it without the one that is wrong"
                    )
                way[frame] = None
                frame = self._parents[frame]
            ends |= way.keys()

    def trees(self) -> list[list[str]]:
        """Return the frames that are connected, for each part of a tree that is not one."""
        left, found = set(self.frames), []
        while left:
            part = set(self._reached(min(left)))
            found.append(sorted(part))
            left -= part
        return found

    def way(self, target: str, source: str) -> list[tuple[Edge, bool]]:
        """Return the steps from one frame to another: a pair of parent and child, and whether it is gone downwards.

        Raises:
            CaptureError: a frame is not there, or nothing leads from one to the other.
        """
        if target == source:
            return []
        for frame in (target, source):
            if frame not in self._parents and frame not in self._parents.values():
                raise CaptureError(f"{self._where}: tf has no frame {frame!r:.100}; it has {_named(self.frames)}")
        before = self._reached(source)
        if target not in before:
            trees = "; ".join(f"tree {number}: {_named(part)}" for number, part in enumerate(self.trees(), 1))
            raise CaptureError(f"{self._where}: tf does not connect {source!r} with {target!r}. {trees}")
        steps, frame = list[tuple[Edge, bool]](), target
        while frame != source:
            nearer = before[frame]
            assert nearer is not None
            steps.append(((frame, nearer), True) if self._parents.get(nearer) == frame else ((nearer, frame), False))
            frame = nearer
        return steps

    def why_none(self, target: str, source: str, time: int, max_gap: int) -> str | None:
        """Say why there is no pose at a time; None = there is one."""
        for edge, _ in self.way(target, source):
            if edge in self._static:
                continue
            gap = self._moving[edge].gap(time)
            if gap > max_gap:
                beyond = "no pose before and after it" if gap == float("inf") else f"a pose {gap / 1e9:.3g} s off"
                return f"tf from {edge[1]!r} to {edge[0]!r} has {beyond}, not within {max_gap / 1e9:g} s"
        return None

    def pose(self, target: str, source: str, time: int, max_gap: int) -> Tensor:
        """Return the (4, 4) float64 target_from_source at a time.

        Raises:
            CaptureError: nothing leads from one to the other, or not at that time.
        """
        if why := self.why_none(target, source, time, max_gap):
            raise CaptureError(f"{self._where}: {why}")
        matrix = torch.eye(4, dtype=torch.float64, device="cpu")
        for edge, downwards in self.way(target, source):
            step = self._static[edge] if edge in self._static else self._moving[edge].pose(time)
            matrix = matrix @ (step if downwards else rigid.invert_rigid(step))
        return matrix

    def streams(self, times: NDArray[np.int64], max_gap: int) -> list[dict[str, Any]]:
        """Return what is joined of each pair of frames that moves, in numbers."""
        told = []
        for (parent, child), track in self._moving.items():
            found = joined(times, track.times, "slerp", max_gap)
            reached = found.gap[found.found]
            span = int(track.times[-1] - track.times[0]) if len(track.times) > 1 else 0
            told.append(
                {
                    "topic": "tf",
                    "type": f"{parent} from {child}",
                    "role": "pose",
                    "rule": "slerp",
                    "rate_hz": (len(track.times) - 1) * 1e9 / span if span else 0.0,
                    **found.counts(),
                    "largest_gap_s": float(reached.max()) / 1e9 if len(reached) else 0.0,
                }
            )
        return told

    def only(self, ways: Iterable[Edge]) -> FrameTree:
        """Return the tree of what leads between some pairs of frames."""
        edges = {edge for target, source in ways for edge, _ in self.way(target, source)}
        return FrameTree(
            self._where,
            {edge: track for edge, track in self._moving.items() if edge in edges},
            {edge: pose for edge, pose in self._static.items() if edge in edges},
        )

    def _reached(self, start: str) -> dict[str, str | None]:
        """Return every frame that is connected with one, and through which it is reached first."""
        children: dict[str, list[str]] = {}
        for child, parent in self._parents.items():
            children.setdefault(parent, []).append(child)
        before: dict[str, str | None] = {start: None}
        waiting = deque([start])
        while waiting:
            frame = waiting.popleft()
            beside = [*children.get(frame, []), *([self._parents[frame]] if frame in self._parents else [])]
            for other in beside:
                if other not in before:
                    before[other] = frame
                    waiting.append(other)
        return before


class TreeBuilder:
    """Takes messages of tf in any order; of transforms of one time the first counts, of static ones the last.

    Topics that are taken from come one after another, in the order in which their takers were made.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._recorded: list[NDArray[np.int64]] = []  # by topic, of each of its messages
        self._moving: dict[Edge, _Rows] = {}
        self._static: dict[Edge, tuple[tuple[int, int], list[float]]] = {}
        self._restated: dict[Edge, int] = {}  # static transforms that another message of the pair contradicts

    def taker(
        self, *, static: bool, recorded: NDArray[np.int64], by_recorder: bool = False
    ) -> Callable[[int, Any], None]:
        """Return what takes the messages of a topic, each with its number in it.

        ``recorded`` are the times of recording, which count ``by_recorder``, and not the stamp of each transform.
        """
        topic = len(self._recorded)
        self._recorded.append(recorded)

        def take(number: int, message: Any) -> None:
            order = (topic, number)
            for one in message.transforms if hasattr(message, "transforms") else [message]:
                edge = (plain_frame(one.header.frame_id), plain_frame(one.child_frame_id))
                if edge[0] == edge[1]:
                    continue  # tf2 passes over it too
                shift, turn = one.transform.translation, one.transform.rotation
                numbers = [float(value) for value in (shift.x, shift.y, shift.z, turn.x, turn.y, turn.z, turn.w)]
                if not static:
                    self._moving.setdefault(edge, _Rows()).add(
                        order, int(recorded[number]) if by_recorder else stamp(one), numbers
                    )
                    continue
                if edge in self._static and not _same_pose(self._static[edge][1], numbers):
                    self._restated[edge] = self._restated.get(edge, 0) + 1
                if edge not in self._static or order >= self._static[edge][0]:
                    self._static[edge] = (order, numbers)

        return take

    def contradictions(self, edges: Collection[Edge]) -> list[str]:
        """Say which transforms of some pairs of frames contradict others of the same pair, and which of them count."""
        told = [
            f"tf gives {child!r} in {parent!r} {count + 1} different static poses; the last counts"
            for (parent, child), count in self._restated.items()
            if (parent, child) in edges
        ]
        for (parent, child), rows in self._moving.items():
            if (parent, child) in edges and (parent, child) not in self._static and (count := rows.contradicted()):
                told.append(
                    f"tf gives {child!r} in {parent!r} two different poses at one time, {count} times; the first "
                    "counts: record one of those who publish it"
                )
        return told

    def lateness(self, edges: Collection[Edge]) -> dict[str, float | None]:
        """Return by how many seconds some pairs of frames that move were recorded after their times."""
        return {
            f"tf from {child!r} to {parent!r}": rows.lateness(self._recorded)
            for (parent, child), rows in self._moving.items()
            if (parent, child) in edges and (parent, child) not in self._static
        }

    def tree(self) -> FrameTree:
        """Return the tree.

        Raises:
            CaptureError: a pose cannot be right, or a frame has two parents.
        """
        moving, static = {}, {}
        for edge, (_, numbers) in self._static.items():
            static[edge] = self._track(edge, [0], np.array([numbers])).pose(0)
        for edge, rows in self._moving.items():
            if edge not in static:
                moving[edge] = self._track(edge, *rows.first_of_each_time())
        return FrameTree(self._where, moving, static)

    def _track(self, edge: Edge, times: list[int], table: Any) -> Trajectory:
        return Trajectory(f"{self._where}: tf from {edge[1]!r} to {edge[0]!r}", times, table[:, :3], table[:, 3:])


class _Rows:
    """The poses of one frame, in plain arrays: recordings have millions."""

    def __init__(self) -> None:
        self._order, self._times, self._numbers = array("q"), array("q"), array("d")

    def add(self, order: tuple[int, int], time: int, numbers: list[float]) -> None:
        self._order.extend(order)
        self._times.append(time)
        self._numbers.extend(numbers)

    def contradicted(self) -> int:
        """Return at how many times there are poses that differ."""
        times, table = np.array(self._times, np.int64), np.array(self._numbers, np.float64).reshape(-1, 7)
        order = np.argsort(times, kind="stable")
        times, table = times[order], table[order]
        again = np.flatnonzero(times[1:] == times[:-1])
        return len({int(times[one]) for one in again if not _same_pose(table[one], table[one + 1])})

    def lateness(self, recorded: Sequence[NDArray[np.int64]]) -> float | None:
        topic, number = np.array(self._order, np.int64).reshape(-1, 2).T
        times = np.empty(len(topic), np.int64)
        for one in np.unique(topic).tolist():
            times[topic == one] = recorded[one][number[topic == one]]
        return lateness(times, np.array(self._times, np.int64))

    def first_of_each_time(self) -> tuple[list[int], NDArray[np.float64]]:
        """Return the times in order, and the (N, 7) numbers of the first pose of each."""
        topic, number = np.array(self._order, np.int64).reshape(-1, 2).T
        by_message = np.lexsort((number, topic))
        times, first = np.unique(np.array(self._times, np.int64)[by_message], return_index=True)
        table = np.array(self._numbers, np.float64).reshape(-1, 7)
        return times.tolist(), table[by_message[first]]


def _same_pose(one: Any, other: Any) -> bool:
    """Whether two poses (x y z and a quaternion, which may have the other sign) differ by rounding alone."""
    a, b = np.asarray(one, np.float64), np.asarray(other, np.float64)
    turn = min(np.abs(a[3:] - b[3:]).max(), np.abs(a[3:] + b[3:]).max())
    return bool(np.abs(a[:3] - b[:3]).max() <= 1e-6 and turn <= 1e-6)


def plain_frame(name: str) -> str:
    """Return a frame's name without the slash that ROS 1 may begin it with."""
    return str(name).removeprefix("/")


def _named(frames: list[str]) -> str:
    return ", ".join(frames[:20]) + (f" and {len(frames) - 20} more" if len(frames) > 20 else "") or "none"
