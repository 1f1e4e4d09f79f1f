"""Replay buffers: the zarr version 2 directories of diffusion policy, of DP3, and of those that took its loader over.

Source: YanjieZe/3D-Diffusion-Policy, ``diffusion_policy_3d/common/replay_buffer.py``, ``dataset/adroit_dataset.py``,
``dataset/dexart_dataset.py``, ``scripts/convert_real_robot_data.py``; real-stanford/diffusion_policy,
``dataset/blockpush_lowdim_dataset.py`` (obs), ``dataset/pusht_dataset.py`` (state, keypoint), has the same
buffer. YanjieZe/Improved-3D-Diffusion-Policy, ``dataset/gr1_dex_dataset_3d.py``; ManiFlow,
``maniflow/dataset/robotwin_dataset.py``; TEA-Lab/DemoGen, ``demo_generation/demogen.py`` and its policies'
``dataset/robosuite_dataset.py``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import ConfigError, ContractError, near_matches
from pcdata.exports.copies import copies_among, copy_name
from pcdata.exports.episode_signals import next_row, signal_row
from pcdata.exports.episodes import Given, episode_names, read_episodes
from pcdata.exports.model_contracts import require_cloud
from pcdata.exports.padding_ranges import PaddingRanges
from pcdata.exports.registry import register_target
from pcdata.exports.sample_needs import check_channels, check_same_count, one_cloud
from pcdata.exports.target import CloudArray, Item, Note, Samples, Target
from pcdata.exports.zarr_v2 import Compression, RowWriter, write_group
from pcdata.files.sample_names import counted
from pcdata.io.store.sample_keys import key_of
from pcdata.models import contract
from pcdata.structures import DepthFrame, Episode, PointCloud
from pcdata.structures.pose_rows import checked_pose_layout

_CHUNK = 100  # timesteps, as the original converters have it
# The loaders ask for img, of any size, read all of it into memory and use none of it: one pixel per timestep will do.
_IMAGE = (1, 1, 3)
_ROBOT = "imagin_robot"

Rows = dict[str, NDArray[np.float32]]  # name of an array -> what it holds of one timestep


@dataclass(frozen=True, kw_only=True)
class _ReplayBuffer(Target):
    """A zarr directory; give it to the loader as ``zarr_path``.

    States and actions are signals of the clouds, in the coordinates of each cloud; or, for clouds without signals,
    those of ``episodes``.

    Args:
        state: the signals that make the state, side by side, with commas between them.
        action: the signals that make the action.
        poses: how poses are written in states and actions: xyz_rot6d_rows, xyz_quat_xyzw or another layout of a row
            (docs/signals.md); "" = as they were recorded, and those that are 4x4 as xyz_rot6d_rows.
        next_state: the action of a step is the state of the next one, in the coordinates of the step; the last step of
            every episode has none and is left out.
        episodes: states, actions and which samples make an episode, of clouds that have no signals; see
            :func:`pcdata.exports.episodes.read_episodes`.
        colors: store xyz and rgb; False = xyz alone.
        arrays: further signals, with commas between them, each stored as an array of its own name and shape.
        image: store an array ``img`` of zeros, a pixel per step, which some of the data sets ask for and none uses.
        frame: the frame that the clouds must be in; None = that of the first.
        num_points: points of every cloud, where they are others than those that the policy is used with.
        compression: of the chunks.
    """

    takes: ClassVar[Literal["clouds"]] = "clouds"
    of_episodes: ClassVar[bool] = True
    any_crop: ClassVar[bool] = True
    color: ClassVar[str] = ""  # what its contract calls colors; "" = the layout has none
    state_arrays: ClassVar[tuple[str, ...]] = ("state",)
    signal_arrays: ClassVar[tuple[str, ...]] = ()  # further arrays, each a signal of its name
    scales: ClassVar[bool] = True  # the policy scales x, y, z by their range over all rows
    window: ClassVar[tuple[int, int, int]] = (16, 2, 8)  # of its configuration: horizon, steps observed, steps acted

    state: str = "state"
    action: str = "action"
    poses: str = ""
    next_state: bool = False
    episodes: Given | None = None
    arrays: str = ""
    colors: bool = True
    image: bool = True
    frame: str | None = None
    num_points: int | None = None
    compression: Compression = "zlib"

    @classmethod
    def cloud_arrays(cls, folder: Path, options: Mapping[str, Any]) -> dict[Path, CloudArray]:
        """One array of all timesteps."""
        colors = bool(options.get("colors", cls.colors))
        return {folder: CloudArray("data/point_cloud", ("xyz", cls.color) if colors else ("xyz",))}

    @property
    def robot_stays(self) -> bool:
        """Whether states and actions come from side files."""
        return self.episodes is not None

    @property
    def channels(self) -> tuple[str, ...]:
        """What the columns of a point are called by its contract."""
        if self.colors and not self.color:
            raise ConfigError(f"{self.name}: its clouds have x, y and z alone; leave out colors=true")
        return ("xyz", self.color) if self.colors else ("xyz",)

    @property
    def further(self) -> tuple[str, ...]:
        """The arrays that are signals of their names.

        Raises:
            ConfigError: a name that is no file's, or of an array that there is.
        """
        asked = tuple(name for name in map(str.strip, self.arrays.split(",")) if name)
        taken = {"point_cloud", "action", "img", *self.state_arrays, *self.signal_arrays}
        for number, name in enumerate(asked):
            if name in taken or name in asked[:number]:
                raise ConfigError(f"{self.name}: arrays: {name!r} is an array already; name it once")
            if name != key_of(name):
                raise ConfigError(
                    f"{self.name}: arrays: {name!r:.100} becomes a file name, so it must be of letters, digits, '_', "
                    "'-' and '.'; attach the signal under such a name"
                )
        return (*self.signal_arrays, *asked)

    def items(self, ids: Sequence[str]) -> list[Item]:
        """One array of all timesteps: one item."""
        return self.plan(ids, (), ())

    def plan(self, ids: Sequence[str], episodes: Sequence[Episode], left_out: Collection[str]) -> list[Item]:
        """Whole episodes alone: one with a step that does not fit is left out, since nothing goes on across a gap."""
        if self.poses:
            checked_pose_layout(f"{self.name}: poses", self.poses)
            if self.episodes is not None:
                raise ConfigError(f"{self.name}: poses is for signals; the files of episodes are written as they are")
        known = self.channels and set(ids)
        further = self.further
        if self.episodes is None:
            given: Iterator[tuple[str, Sequence[str]]] = (
                (one.id, ids[one.first : one.first + one.length]) for one in episodes
            )
            if not episodes:
                raise ConfigError(
                    f"{self.name}: needs to know which samples make an episode, and the source does not say: put "
                    "episodes.json beside the captures (pcdata.write_episodes) before 'pcdata build'; for clouds "
                    "without signals say the option episodes: a folder with one .npz per episode that has samples "
                    "(T,), the sample ids in order, state (T, Ds) and action (T, Da); in Python also a mapping"
                )
        else:
            if self.next_state:
                raise ConfigError(f"{self.name}: next_state is for signals; the files of episodes state the actions")
            given = self._episodes_of_files(known, further)
        order: list[str] = []
        kept: list[Episode] = []
        for name, samples in given:
            short = self.next_state and len(samples) < 2
            if not short and not any(sample_id in left_out for sample_id in samples):
                kept.append(Episode(name, len(order), len(samples)))
                order += samples
        last = [order[one.first + one.length - 1] for one in kept] if self.next_state else []
        unwritten = dict.fromkeys(last, "the last step of its episode: its action would be the state after it")
        return [Item(tuple(order), (".zgroup", "data", "meta"), tuple(kept), unwritten)] if kept else []

    def _episodes_of_files(self, known: Collection[str], further: Sequence[str]) -> Iterator[tuple[str, Sequence[str]]]:
        assert self.episodes is not None
        names = episode_names(self.name, self.episodes)
        for episode in read_episodes(self.name, self.episodes, names, further):
            for sample_id in episode.samples:
                if sample_id not in known:
                    raise ConfigError(
                        f"{self.name}: episode {episode.name!r} names sample {sample_id!r}, which is not exported"
                        f"{near_matches(sample_id, known)}"
                    )
            for copy in copies_among(episode.samples, known):
                yield copy_name(episode.name, copy), [copy_name(one, copy) for one in episode.samples]

    def examine(
        self, item: Item, sample_id: str, data: DepthFrame | PointCloud, seen: dict[str, Any]
    ) -> tuple[PointCloud, Rows]:
        """Return the cloud and what the arrays hold of it, but for actions that are the next state."""
        where = f"{self.name}: sample {sample_id!r}"
        cloud = one_cloud(where, data)
        points: NDArray[np.float32] = cloud.points.numpy()
        if self.colors:
            check_channels(where, cloud, ["colors"], "; or say colors=false for xyz alone")
            assert cloud.colors is not None
            scale = np.float32(255 if self.color == "rgb_255" else 1)
            points = np.concatenate([points, cloud.colors.numpy() * scale], axis=1)
        # The policy is fed one frame: that of the first.
        frame = self.frame or seen.get("frame", cloud.frame_id)
        stated: dict[str, Any] = {"crop": None, "channels": self.channels}
        if not contract(self.model).frame:
            stated["frame"] = frame
        if self.num_points is not None:
            stated["num_points"] = self.num_points
        require_cloud(where, self, cloud, **stated)
        check_same_count(where, cloud, seen.get("count", cloud.num_points))
        rows: Rows = {"point_cloud": points}
        if self.episodes is None:
            before: Rows = seen.get("before", {})
            state = signal_row(where, cloud, "state", self.state, poses=self.poses, before=before.get("state"))
            rows.update(dict.fromkeys(self.state_arrays, state))
            if not self.next_state:
                former = before.get("action")
                rows["action"] = signal_row(where, cloud, "action", self.action, poses=self.poses, before=former)
            for name in self.further:
                rows[name] = signal_row(where, cloud, name, name, free=True, before=before.get(name))
            for name, row in rows.items():
                if row.shape != seen.setdefault(f"shape of {name}", row.shape):
                    wanted = seen[f"shape of {name}"]
                    raise ContractError(
                        f"{where}: {name} is {row.shape}, that of the samples before {wanted}; one robot, one width"
                    )
            seen["before"] = {"state": state, **rows}
        seen["frame"], seen["count"] = frame, cloud.num_points
        return cloud, rows

    def write(self, item: Item, samples: Samples, folder: Path, note: Note) -> None:
        """Write the arrays side by side, a chunk of timesteps at a time."""
        for group in (folder, folder / "data", folder / "meta"):
            write_group(group)
        arrays = _Arrays(folder / "data", len(item.ids) - len(item.unwritten), self.compression)
        ranges = PaddingRanges()
        for sample_id, rows in self._steps(item, samples):
            arrays.add(rows)
            ranges.add(sample_id, rows["point_cloud"])
        if self.episodes is not None:
            for robot in self._robot_of_files(item):
                arrays.add(robot)
        if self.image:
            arrays.zeros("img", _IMAGE, "|u1")
        lengths = [one.length - bool(self.next_state) for one in item.episodes]
        ends = RowWriter(folder / "meta/episode_ends", (len(lengths),), "<i8", chunk_rows=_CHUNK, compression="none")
        for end in np.cumsum(lengths, dtype=np.int64):
            ends.add(end)
        horizon, observed, acted = self.window
        # A sequence may reach observed - 1 steps before an episode and acted - 1 beyond it.
        shortest = horizon - (observed - 1) - (acted - 1)
        short = [one.id for one, length in zip(item.episodes, lengths) if length < shortest]
        if short:
            note(
                f"{counted(len(short), 'episode')} of fewer than {shortest} steps (first: {short[0]!r}): the loader "
                f"cuts no sequence from such with its horizon of {horizon}, {observed} observed and {acted} acted steps"
            )
        if self.scales and (warning := ranges.warning(self.name)) is not None:
            note(warning)

    def _steps(self, item: Item, samples: Samples) -> Iterator[tuple[str, Rows]]:
        """Yield the timesteps, whole; where actions are next states, one later than they come."""
        seen: dict[str, Any] = {}
        first = {one.first for one in item.episodes}
        last = {one.first + one.length - 1 for one in item.episodes}
        before: tuple[str, PointCloud, Rows] | None = None
        for number, (sample_id, data) in enumerate(samples):
            if number in first:
                seen.pop("before", None)  # no trajectory goes on from another episode
            cloud, rows = self.examine(item, sample_id, data, seen)
            if not self.next_state:
                yield sample_id, rows
                continue
            if before is not None:
                name, former, former_rows = before
                where = f"{self.name}: sample {name!r}"
                state = former_rows[self.state_arrays[0]]
                former_rows["action"] = next_row(where, former, cloud, self.state, poses=self.poses, before=state)
                yield name, former_rows
            before = None if number in last else (sample_id, cloud, rows)

    def _robot_of_files(self, item: Item) -> Iterator[Rows]:
        assert self.episodes is not None
        known = set(item.ids)
        names = episode_names(self.name, self.episodes)
        planned = [one.id for one in item.episodes]
        wanted, written = set(planned), []
        for episode in read_episodes(self.name, self.episodes, names, self.further):
            for copy in copies_among(episode.samples, known):
                name = copy_name(episode.name, copy)
                if name not in wanted:
                    continue
                written.append(name)
                for step in range(len(episode.samples)):
                    rows = {key: array[step] for key, array in episode.arrays.items()}
                    state = rows.pop("state")
                    yield {**rows, **dict.fromkeys(self.state_arrays, state)}
        if written != planned:
            raise ConfigError(f"{self.name}: the episodes changed while they were exported; export again")


class _Arrays:
    """The arrays of a buffer by name, each made when its first row comes."""

    def __init__(self, folder: Path, total: int, compression: Compression) -> None:
        self._folder, self._total, self._compression = folder, total, compression
        self._writers: dict[str, RowWriter] = {}

    def add(self, rows: Rows) -> None:
        for name, row in rows.items():
            if name not in self._writers:
                self.zeros(name, row.shape, "<f4")
            self._writers[name].add(row)

    def zeros(self, name: str, shape: tuple[int, ...], dtype: str) -> None:
        """Make an array, which reads as zeros as far as no rows come."""
        self._writers[name] = RowWriter(
            self._folder / name, (self._total, *shape), dtype, chunk_rows=_CHUNK, compression=self._compression
        )


def _buffer(name: str, model: str, arrays: str, *, colors: bool = True, image: bool = False, **facts: Any) -> Any:
    """Return the target of one project: the buffer with its facts and its own defaults."""
    layout = f"zarr v2: {', '.join(f'data/{array}' for array in arrays.split())}, meta/episode_ends"
    own = {"colors": colors, "image": image}
    body = {
        "__doc__": _ReplayBuffer.__doc__,
        "__module__": __name__,
        "__annotations__": dict.fromkeys(own, "bool"),
        **own,
        **dict(facts, name=name, model=model, layout=layout),
    }
    made = type(f"_{name.title().replace('_', '')}", (_ReplayBuffer,), body)
    return dataclass(frozen=True, kw_only=True)(made)


REPLAY_BUFFERS: tuple[type[Target], ...] = (
    _buffer(
        "dp3", "dp3_sim", "point_cloud state action img", image=True, color="rgb_255", also={"dp3_real": frozenset()}
    ),
    _buffer(
        "dexart",
        "dexart",
        "point_cloud imagin_robot state action img",
        image=True,
        colors=False,
        scales=False,
        signal_arrays=(_ROBOT,),
    ),
    _buffer("idp3", "idp3", "point_cloud state action", color="rgb_255", scales=False, window=(16, 2, 15)),
    _buffer("maniflow", "maniflow", "point_cloud state action", color="rgb", window=(16, 2, 16)),
    _buffer(
        "demogen",
        "demogen",
        "point_cloud state agent_pos action",
        colors=False,
        color="rgb_255",
        state_arrays=("state", "agent_pos"),
    ),
    _buffer(
        "diffusion_policy",
        "dp3_sim",
        "obs state action point_cloud",
        color="rgb_255",
        scales=False,
        state_arrays=("obs", "state"),
        also={"dp3_real": frozenset()},
    ),
)
for _target in REPLAY_BUFFERS:
    register_target(_target)
