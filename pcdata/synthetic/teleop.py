"""A simulated teleoperated set: a hand grasps a cube and brings it to a goal, seen by cameras around the table.

All that is true of a step is known: where hand, cube and goal are, what the arm's joints are and what was commanded.
The world can be stepped by any policy, so a trained one can be tried in it.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pcdata.errors import ConfigError
from pcdata.files.sample_names import check_known
from pcdata.geometry import rigid
from pcdata.rng import generator_for
from pcdata.structures import DepthFrame, Episode, Signal
from pcdata.structures.captures import Captures
from pcdata.synthetic.scene import make_table
from pcdata.synthetic.shapes import Box, Cylinder, Shape
from pcdata.synthetic.tabletop import BASE_FRAME, rendered
from pcdata.synthetic.viewpoints import place_cameras
from pcdata.threads import torch_on_one_thread

CUBE, GOAL, HAND = 1, 2, 3  # labels; 0 is the table
CUBE_SIZE = 0.05  # metres
GOAL_RADIUS = 0.05
INSTRUCTION = "put the cube on the green disc"

_GOAL_HEIGHT = 0.006
_HAND_RADIUS, _HAND_HEIGHT = 0.012, 0.12
_SPEED = 0.04  # metres that the hand goes in one step
_GRASP = 0.02  # metres between hand and cube at which closing holds it
_ARRIVED = 0.004
_SECONDS = 0.1  # from step to step
_SHOULDER = (-0.5, 0.0, 0.3)  # of the arm, in the base frame
_LINK = 0.5  # metres, of both links
_MOST_STEPS = 80

Position = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class TeleopState:
    """What is true at one step, in metres in the base frame; of the hand its tip, of the cube its middle."""

    hand: Position
    cube: Position
    goal: Position  # where the middle of the cube shall come to rest
    is_open: bool = True  # the hand
    holds: bool = False

    @property
    def distance(self) -> float:
        """Metres from the cube to the goal."""
        return math.dist(self.cube, self.goal)

    def next(self, target: Position, opening: float) -> TeleopState:
        """Return the state after one step of a command: where to go, and whether to open (above 0.5) the hand there.

        The hand goes 4 cm at most. A hand that closes within 2 cm of the cube's middle holds it; one that opens lets it
        fall onto the table.
        """
        gap = math.dist(self.hand, target)
        part = min(1.0, _SPEED / gap) if gap > 0 else 0.0
        hand = _position(*(own + part * (end - own) for own, end in zip(self.hand, target)))
        is_open = opening > 0.5
        cube = self.cube
        if self.holds:
            cube = _position(*(c + h - o for c, h, o in zip(cube, hand, self.hand)))
        if self.holds and is_open:
            cube = (cube[0], cube[1], CUBE_SIZE / 2)
        holds = not is_open and (self.holds or (self.is_open and math.dist(hand, cube) <= _GRASP))
        return replace(self, hand=hand, cube=cube, is_open=is_open, holds=holds)

    def command(self) -> tuple[Position, float]:
        """Return what the operator does: go for the cube and close there, then for the goal and open there."""
        if self.holds:
            return self.goal, float(math.dist(self.hand, self.goal) <= _ARRIVED)
        return self.cube, float(math.dist(self.hand, self.cube) > _ARRIVED)

    def joints(self) -> list[float]:
        """Return the arm's angles in radians: turn of the base, shoulder, elbow, pitch and roll of the wrist.

        Two links of 0.5 m from the shoulder; the hand points down.
        """
        x, y, z = (own - start for own, start in zip(self.hand, _SHOULDER))
        reach = math.hypot(x, y)
        elbow = math.acos(max(-1.0, min(1.0, (reach**2 + z**2) / (2 * _LINK**2) - 1)))
        shoulder = math.atan2(z, reach) + elbow / 2
        turn = math.atan2(y, x)
        return [turn, shoulder, -elbow, -math.pi / 2 - shoulder + elbow, self._yaw() - turn]

    def hand_pose(self) -> Tensor:
        """Return (4, 4) float64 base_from_hand: z points down, x away from the robot's base."""
        turn = torch.tensor(self._yaw(), dtype=torch.float64, device="cpu")
        upright = rigid.rotation_about_axis(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, device="cpu"), turn)
        down = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64, device="cpu"))
        return rigid.from_rotation_translation(
            upright @ down, torch.tensor(self.hand, dtype=torch.float64, device="cpu")
        )

    def signals(self) -> dict[str, Signal]:
        """Return what a robot records at this step, B = 1: its state, and the command as the action."""
        target, opening = self.command()

        def row(*values: float) -> Tensor:
            return torch.tensor([values], dtype=torch.float32, device="cpu")

        return {
            "joints": Signal(row(*self.joints()), "invariant"),
            "gripper": Signal(row(float(self.is_open)), "invariant"),
            "hand": Signal(self.hand_pose().float()[None], "pose matrix", BASE_FRAME),
            "action": Signal(row(*target, opening), "position + invariant 1", BASE_FRAME),
            "instruction": Signal((INSTRUCTION,), "text"),
        }

    def shapes(self) -> tuple[Shape, ...]:
        """Return cube, goal and hand as solids."""
        x, y, z = self.hand
        size = (CUBE_SIZE, CUBE_SIZE, CUBE_SIZE)
        return (
            Box(base_from_object=_at(*self.cube), size=size, label=CUBE, color=(0.7, 0.03, 0.03)),
            Cylinder(
                base_from_object=_at(self.goal[0], self.goal[1], _GOAL_HEIGHT / 2),
                radius=GOAL_RADIUS, height=_GOAL_HEIGHT, label=GOAL, color=(0.03, 0.5, 0.05),
            ),
            Cylinder(
                base_from_object=_at(x, y, z + _HAND_HEIGHT / 2),
                radius=_HAND_RADIUS, height=_HAND_HEIGHT, label=HAND, color=(0.03, 0.06, 0.6),
            ),
        )  # fmt: skip

    def _yaw(self) -> float:
        return math.atan2(self.hand[1] - _SHOULDER[1], self.hand[0] - _SHOULDER[0])


@dataclass(frozen=True, kw_only=True)
class TeleopSource(Captures):
    """``num_episodes`` demonstrations of one task as captures with signals; each is rendered when it is loaded.

    Samples are called ``NAME-EPISODE-STEP``. Every step has the signals joints (5, radians), gripper (1 = open), hand
    (its pose in the base frame), action (x, y, z to go to in the base frame, and whether to open) and instruction.

    Args:
        num_episodes: demonstrations, each with its own places of hand, cube and goal.
        seed: of the first; episode i is that of ``seed + i``.
        num_views: cameras, which stand still, the same in all episodes.
        size: (height, width) in pixels.
        name: what goes before the ids.
    """

    num_episodes: int = 30
    seed: int = 0
    num_views: int = 3
    size: tuple[int, int] = (96, 128)
    name: str = "teleop"

    def __post_init__(self) -> None:
        if self.num_episodes < 1 or self.seed < 0 or self.num_views < 1:
            raise ConfigError(
                "TeleopSource: needs num_episodes and num_views of at least 1 and seed >= 0, got "
                f"{self.num_episodes}, {self.num_views} and {self.seed}"
            )

    @property
    def episodes(self) -> list[Episode]:
        """The demonstrations; all reach their goal."""
        found, first = [], 0
        for number in range(self.num_episodes):
            length = len(demonstration(self.seed + number))
            times = [step * _SECONDS for step in range(length)]
            attributes = {"instruction": INSTRUCTION, "seed": self.seed + number}
            found.append(Episode(f"{self.name}-{self._digits(number)}", first, length, times, attributes))
            first += length
        return found

    @property
    def ids(self) -> list[str]:
        """The sample ids, step after step."""
        return list(self._states())

    def __len__(self) -> int:
        return len(self._states())

    def state(self, sample_id: str) -> TeleopState:
        """Return what is true at a step.

        Raises:
            CaptureError: there is no such sample.
        """
        states = self._states()
        check_known(f"TeleopSource {self.name!r}", sample_id, states)
        return states[sample_id]

    def signals(self, sample_id: str) -> dict[str, Signal]:
        """Return the signals of a step without rendering it.

        Raises:
            CaptureError: there is no such sample.
        """
        return self.state(sample_id).signals()

    def load(self, sample_id: str) -> DepthFrame:
        """Render one step, with its signals.

        Raises:
            CaptureError: there is no such sample.
        """
        return self.render(self.state(sample_id), sample_id)

    @torch_on_one_thread()
    def render(self, state: TeleopState, sample_id: str = "") -> DepthFrame:
        """Return what the cameras see of any state, with its signals."""
        camera, poses = place_cameras(0, self.num_views, self.size)
        truth, colors = rendered(camera, poses, make_table(), None, state.shapes(), lit=False)
        return DepthFrame(
            depth=truth.depth.float(),
            camera=truth.camera,
            colors=colors,
            labels=truth.labels,
            world_from_camera=poses,
            frame_id=BASE_FRAME,
            sample_id=sample_id,
            recorded_signals=state.signals(),
            provenance={"source": "pcdata.synthetic.teleop", "seed": self.seed},
        )

    def _states(self) -> dict[str, TeleopState]:
        return _states(self.name, self.seed, self.num_episodes)

    def _digits(self, number: int) -> str:
        return _digits(number, self.num_episodes)


def start(seed: int) -> TeleopState:
    """Return where an episode begins: hand above the table, cube and goal on it and apart."""
    generator = generator_for(seed, 0, "synthetic/teleop")
    while True:
        draw = (2.0 * torch.rand(7, generator=generator, dtype=torch.float64, device="cpu") - 1.0).tolist()
        cube = _position(0.17 * draw[0], 0.17 * draw[1], CUBE_SIZE / 2)
        goal = _position(0.17 * draw[2], 0.17 * draw[3], CUBE_SIZE / 2)
        hand = _position(0.15 * draw[4], 0.15 * draw[5], 0.2 + 0.05 * draw[6])
        if math.dist(cube, goal) > 0.14:
            return TeleopState(hand=hand, cube=cube, goal=goal)


@functools.lru_cache(maxsize=256)
def demonstration(seed: int) -> tuple[TeleopState, ...]:
    """Return the states of one episode: the operator brings the cube to the goal and lets it go."""
    states = [start(seed)]
    while len(states) < _MOST_STEPS and not (states[-1].is_open and states[-1].distance < _ARRIVED):
        states.append(states[-1].next(*states[-1].command()))
    return tuple(states)


@functools.lru_cache(maxsize=16)
def _states(name: str, seed: int, num_episodes: int) -> dict[str, TeleopState]:
    return {
        f"{name}-{_digits(number, num_episodes)}-{step:04d}": state
        for number in range(num_episodes)
        for step, state in enumerate(demonstration(seed + number))
    }


def _digits(number: int, count: int) -> str:
    return f"{number:0{max(3, len(str(count - 1)))}d}"  # equal widths: text order is number order


def _position(x: float, y: float, z: float) -> Position:
    return x, y, z


def _at(x: float, y: float, z: float) -> Tensor:
    position = torch.tensor([x, y, z], dtype=torch.float64, device="cpu")
    return rigid.from_rotation_translation(torch.eye(3, dtype=torch.float64, device="cpu"), position)
