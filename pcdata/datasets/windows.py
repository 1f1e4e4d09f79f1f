"""EpisodeWindows: what a policy is shown and what it should do then, cut from episodes."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.datasets.cached import CachedCloudDataset
from pcdata.datasets.mixed import MixedCloudDataset
from pcdata.datasets.samples import SampleDataset, runs_on_batches
from pcdata.datasets.window_places import window_places, window_steps
from pcdata.errors import ConfigError, DTypeError, FrameError, PcdataWarning, ShapeError, near_matches
from pcdata.rng import Streams
from pcdata.structures import CAMERA_FRAME, Episode, PointCloud, Signal
from pcdata.structures.episodes import checked_episodes
from pcdata.structures.signals import is_frame_of_camera
from pcdata.structures.structure import derived
from pcdata.structures.unbatched import Unbatched

WINDOW = "window"  # in the meta of a window's clouds: what collate_windows must know

_STILL = 1e-6  # metres and parts of a rotation by which the poses of a camera that stands still may differ
_MOST = 1_000_000  # steps of a window: more is a mistake, and would fill the memory


class EpisodeWindows(SampleDataset):
    """Windows over the episodes of a dataset: one sample is the clouds that a policy sees, with its actions.

    A window is ``horizon`` steps of an episode in a row. Its sample is one :class:`~pcdata.PointCloud` of ``num_obs``
    clouds, the first steps of the window, oldest first, each with the signals of its own step. The signals that
    ``actions`` names have those of all steps instead: (num_obs, horizon, ...), the same record in the coordinates of
    each cloud. So row ``num_obs - 1`` is what a policy does that stands at the newest cloud; :func:`collate_windows`
    gives that.

    All clouds of a window get the same random draws, keyed by (seed, epoch, window). Steps beyond an episode repeat its
    first and last one; with ``pad="drop"`` there are no such windows. These are the windows of diffusion policy and DP3
    for ``pad_before = num_obs - 1`` and ``pad_after = num_actions - 1``. Only numbers are computed when it is made; a
    sample reads the clouds it shows and no others.

    Args:
        dataset: of single clouds, on the fly or cached; its transform, seed and ``repeats`` hold for the windows too.
        num_obs: clouds of a window.
        horizon: steps of a window, ``num_obs`` or more.
        num_actions: steps that a policy executes before it looks again, which says how far beyond its episode a window
            may reach; None = all from the newest cloud on, so that each step of an episode is the newest once.
        stride: steps from one window to the next of an episode.
        pad: "repeat" or "drop".
        actions: signals that are given for all steps.
        episodes: those to cut windows from, as :meth:`split_episodes` gives them; None = all.

    Raises:
        ConfigError: numbers that make no window; no episodes; no window fits any of them.
        DTypeError: no dataset of clouds, or a signal that it does not have.
        CaptureError: episodes that do not fit its samples.
    """

    def __init__(
        self,
        dataset: SampleDataset,
        num_obs: int,
        horizon: int,
        *,
        num_actions: int | None = None,
        stride: int = 1,
        pad: Literal["repeat", "drop"] = "repeat",
        actions: Sequence[str] = ("action",),
        episodes: Iterable[Episode] | None = None,
    ) -> None:
        if not isinstance(dataset, SampleDataset) or isinstance(dataset, EpisodeWindows | MixedCloudDataset):
            raise DTypeError(
                f"EpisodeWindows: dataset must be a CloudDataset or CachedCloudDataset, got {type(dataset).__name__}; "
                "choose episodes by episodes=, not by a Subset"
            )
        num_obs, horizon, num_actions, stride = checked_numbers(num_obs, horizon, num_actions, stride, pad)
        own = dataset.episodes if episodes is None else checked_episodes(repr(dataset), episodes, len(dataset.ids))
        if not own:
            raise ConfigError(
                f"EpisodeWindows: {dataset!r} has no episodes; say in episodes.json beside the captures which follow "
                "each other, or give episodes=[Episode(id, first, length), ...]"
            )
        self.dataset = dataset
        self.num_obs, self.horizon, self.num_actions, self.stride, self.pad = num_obs, horizon, num_actions, stride, pad
        self.actions = _checked_actions(actions)
        self._episodes = own
        self._lengths = np.array([episode.length for episode in own], dtype=np.int64)
        self._firsts = np.array([episode.first for episode in own], dtype=np.int64)
        pads = (num_obs - 1, num_actions - 1) if pad == "repeat" else (0, 0)
        self.places = window_places(
            self._lengths.tolist(), horizon=horizon, pad_before=pads[0], pad_after=pads[1], stride=stride
        )
        self.skipped = self._without_windows()
        if not len(self.places.start):
            raise ConfigError(
                f"EpisodeWindows: none of {len(own)} episodes is long enough: {self.least_length} steps are needed, "
                f'the longest has {self._lengths.max()}; take a shorter horizon, more num_actions, or pad="repeat"'
            )
        if self.skipped:
            steps = sum(episode.length for episode in own if episode.id in self.skipped)
            warnings.warn(
                f"EpisodeWindows: {len(self.skipped)} of {len(own)} episodes ({steps} steps) give no window, having "
                f"fewer than {self.least_length} steps; skipped names them",
                PcdataWarning,
                stacklevel=2,
            )
        self._table = self._action_table()
        self._poses: dict[int, Mapping[str, Tensor] | None] = {}  # by episode: of a camera that was looked at, if still
        # The newest step names a window: what is shown then does not depend on how far ahead the window reaches.
        newest = self.places.start + (num_obs - 1)
        ids = [f"{own[number].id}@{step}" for number, step in zip(self.places.episode.tolist(), newest.tolist())]
        super().__init__(ids, dataset.transform, dataset.seed, dataset.repeats)

    @property
    def least_length(self) -> int:
        """The steps that an episode needs to give a window."""
        pads = min(self.num_obs, self.horizon) + self.num_actions - 2 if self.pad == "repeat" else 0
        return max(1, self.horizon - pads)

    @property
    def episodes(self) -> list[Episode]:
        """The episodes that windows are cut from, over the samples of ``dataset``."""
        return list(self._episodes)

    def signal_table(self) -> Mapping[str, Signal]:
        """Return the signals of the samples of ``dataset``; ``steps`` says which of them a window has."""
        return self.dataset.signal_table()

    def steps(self, index: int) -> NDArray[np.int64]:
        """Return the places (horizon,) of a window's steps among the ids of ``dataset``, repeated ones as they are."""
        return self._steps([self._place(index) % len(self.ids)])[0]

    def _steps(self, numbers: Sequence[int] | NDArray[np.int64]) -> NDArray[np.int64]:
        episode = self.places.episode[numbers]
        steps = window_steps(self.places.start[numbers], self._lengths[episode], self.horizon)
        return self._firsts[episode][:, None] + steps

    def set_epoch(self, epoch: int) -> None:
        """Change the random draws, of the windows and of the dataset that they are cut from."""
        super().set_epoch(epoch)
        self.dataset.set_epoch(epoch)

    def _load(self, index: int) -> PointCloud:
        raise DTypeError("EpisodeWindows: a window is no single sample; give the dataset that it is cut from")

    def _made(self, number: int, streams: Streams) -> PointCloud:
        steps = self.steps(number)
        shown, again = np.unique(steps[: self.num_obs], return_inverse=True)
        clouds = self._clouds(shown.tolist(), streams)
        if len(shown) < self.num_obs:
            clouds = PointCloud.cat([clouds[int(place)] for place in again.tolist()])
        return self._with_actions(clouds, [number], steps[None])

    def _made_at_once(self, numbers: NDArray[np.int64], streams: Streams | None) -> Unbatched | None:
        if not isinstance(self.dataset, CachedCloudDataset) or not runs_on_batches(self.transform):
            return None
        steps = self._steps(numbers)
        shown = steps[:, : self.num_obs].ravel()
        batches = []
        for part in self.dataset._parts(shown, self.num_obs):
            clouds, _ = self.dataset._load_at_once(shown[part])
            if clouds is None:
                return None
            windows = slice(part.start // self.num_obs, part.stop // self.num_obs)
            # The clouds of a window get the same draws.
            made = self._transformed(clouds, None if streams is None else streams.part(windows, self.num_obs))
            batches.append(self._with_actions(made, numbers[windows].tolist(), steps[windows]))
        return Unbatched(batches, self.num_obs)

    def _keys_of(self, made: PointCloud, streams: Streams) -> list[int]:
        return streams.keys * made.num_clouds

    def _clouds(self, shown: Sequence[int], streams: Streams) -> PointCloud:
        """Return one cloud for each of these samples, all with the same draws."""
        data = [self.dataset._load(place) for place in shown]
        if all(isinstance(one, PointCloud) and one.num_clouds == 1 for one in data):
            made = [self._transformed(PointCloud.cat(data), streams.part(slice(1), len(data)))]
        else:  # captures: each has views and a size of its own
            made = [self._transformed(one, streams.part(slice(1))) for one in data]
        counts = [one.num_clouds for one in made]
        if sum(counts) != len(shown) or len({*counts}) > 1:
            raise ShapeError(
                f"EpisodeWindows: every sample must become one cloud, but {len(shown)} samples became "
                f"{' + '.join(map(str, counts))} clouds; join views by MergeViews, and leave SplitObjects out"
            )
        return made[0] if len(made) == 1 else PointCloud.cat(made)

    def _with_actions(self, clouds: PointCloud, numbers: Sequence[int], steps: NDArray[np.int64]) -> PointCloud:
        """Give the clouds of W windows, ``num_obs`` each, the actions of their (W, horizon) steps."""
        recorded = dict(clouds.recorded_signals)
        index = torch.from_numpy(steps)
        shown = index[:, : self.num_obs].flatten()
        for name, table in self._table.items():
            own = recorded.get(name)
            if own is None:
                raise DTypeError(
                    f"EpisodeWindows: a step of {self.transform!r} drops the signal {name!r}; keep it, or leave it out "
                    "of actions"
                )
            if not own.same_bits(table.rows(shown)):
                cause = (
                    "a step changed it, which the actions of the other steps would miss: change it where it is recorded"
                    if own.frame == table.frame
                    else f"it is in {own.frame!r}, not in {table.frame!r}, as of views that were turned before they "
                    "were merged: put random motions after ToFrame and MergeViews"
                )
                raise DTypeError(
                    f"EpisodeWindows: the signal {name!r} of the clouds is not what signal_table() says; {cause}"
                )
            others = clouds.frames.keys() - {table.frame}
            if table.frame is not None and is_frame_of_camera(clouds, table.frame) and others:
                for place, number in enumerate(numbers):
                    own_clouds = clouds[place * self.num_obs : (place + 1) * self.num_obs]
                    self._check_still(name, int(self.places.episode[number]), own_clouds)
            values = table.rows(index).values
            assert isinstance(values, Tensor)
            each = values[:, None].expand(-1, self.num_obs, *values.shape[1:])  # of one window the memory is shared
            recorded[name] = derived(table, values=each.flatten(0, 1))
        told: list[dict[str, Any]] = []
        for number in numbers:
            start, length = int(self.places.start[number]), int(self._lengths[self.places.episode[number]])
            window: dict[str, Any] = {
                "id": self.ids[number],
                "num_obs": self.num_obs,
                "actions": list(self._table),
                "real": [max(0, -start), min(self.horizon, length - start)],  # of the horizon's steps, the episode's
            }
            told += [{WINDOW: window}] * self.num_obs
        return derived(clouds.with_meta(told), recorded_signals=recorded)

    def _check_still(self, name: str, number: int, clouds: PointCloud) -> None:
        """Require that a camera, in whose frame actions were recorded, stands still throughout an episode."""
        episode = self._episodes[number]
        if number not in self._poses:
            some = sorted({episode.first, episode.first + episode.length // 2, episode.first + episode.length - 1})
            first, *others = [self._clouds([place], Streams([0])).frames for place in some]
            self._poses[number] = first if all(_all_at(first, one) for one in others) else None
        # One that comes back shows only in the windows between, and each step is shown by one.
        where = self._poses[number]
        if where is None or not _all_at(where, clouds.frames):
            fixed = sorted({*clouds.frames} - {CAMERA_FRAME, str(self._table[name].frame)})
            raise FrameError(
                f"EpisodeWindows: {name!r} was recorded in the frame of a camera that moves in episode {episode.id!r}, "
                "so later steps mean another place than the clouds that they are given with; record it in one of the "
                f"frames {fixed}"
            )

    def _action_table(self) -> dict[str, Signal]:
        if not self.actions:
            return {}
        table = self.dataset.signal_table()
        for name in self.actions:
            if name not in table:
                known = f"it has {', '.join(table)}" if table else "it has none: see docs/episodes.md"
                raise DTypeError(
                    f"EpisodeWindows: {self.dataset!r} has no signal {name!r}{near_matches(str(name), table)}; {known};"
                    " actions=() gives clouds alone"
                )
            if not isinstance(table[name].values, Tensor):
                raise DTypeError(f"EpisodeWindows: {name!r} is a text, which is no action; leave it out of actions")
        return {name: table[name] for name in self.actions}

    def _without_windows(self) -> dict[str, str]:
        counts = np.bincount(self.places.episode, minlength=len(self._episodes))
        return {
            episode.id: f"{episode.length} steps, fewer than {self.least_length}"
            for episode, count in zip(self._episodes, counts.tolist())
            if not count
        }

    def __repr__(self) -> str:
        out = f", {len(self.skipped)} too short" if self.skipped else ""
        return (
            f"EpisodeWindows({self.dataset!r}: {len(self)} windows of {self.num_obs} clouds and {self.horizon} steps "
            f"over {len(self._episodes)} episodes{out})"
        )


def _all_at(poses: Mapping[str, Tensor], frames: Mapping[str, Tensor]) -> bool:
    """Whether frames of some clouds lie where (1, 4, 4) poses say, as far as both know them."""
    return all(torch.allclose(frames[name], poses[name], rtol=0, atol=_STILL) for name in poses.keys() & frames.keys())


def checked_numbers(num_obs: Any, horizon: Any, num_actions: Any, stride: Any, pad: Any) -> tuple[int, int, int, int]:
    """Return the numbers that make windows.

    Raises:
        ConfigError: they make none.
    """
    for name, value in {"num_obs": num_obs, "horizon": horizon, "stride": stride}.items():
        if not (_is_whole(value) and 1 <= value <= _MOST):
            raise ConfigError(f"EpisodeWindows: {name} must be a whole number, 1 to {_MOST}, got {value!r:.100}")
    if horizon < num_obs:
        raise ConfigError(
            f"EpisodeWindows: horizon counts the steps of a window, observed ones too, so it must be num_obs or more, "
            f"got {horizon} and {num_obs}"
        )
    num_actions = horizon - num_obs + 1 if num_actions is None else num_actions
    if not (_is_whole(num_actions) and 1 <= num_actions <= horizon):
        raise ConfigError(f"EpisodeWindows: num_actions must be 1 to the horizon, {horizon}, got {num_actions!r:.100}")
    if pad not in ("repeat", "drop"):
        raise ConfigError(f"EpisodeWindows: pad must be 'repeat' or 'drop', got {pad!r:.100}")
    return int(num_obs), int(horizon), int(num_actions), int(stride)


def _is_whole(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _checked_actions(actions: Any) -> tuple[str, ...]:
    names = [actions] if isinstance(actions, str) else actions
    if not isinstance(names, (list, tuple)) or not all(isinstance(name, str) for name in names):
        raise DTypeError(f"EpisodeWindows: actions must be names of signals, or () for none, got {actions!r:.100}")
    return tuple(names)
