"""A batch of windows: what ``collate_windows`` gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pcdata.datasets.batch_transport import sent_together
from pcdata.datasets.windows import WINDOW
from pcdata.errors import DTypeError, ShapeError
from pcdata.structures import PaddedClouds, PointCloud
from pcdata.structures.signals import signals_now
from pcdata.structures.structure import Structure
from pcdata.structures.unbatched import Unbatched


@sent_together
@dataclass(frozen=True, eq=False, kw_only=True)
class WindowBatch(Structure):
    """B windows of T clouds, oldest first, and what belongs to them; ``to(device)`` moves all of it.

    Args:
        clouds: the B * T clouds, window after window, padded to one length M.
        num_obs: T.
        signals: name -> (B, T, ...) of the observed steps, each in its own cloud's coordinates; (B, horizon, ...) of
            actions, in the coordinates of the newest cloud; B texts, those of the newest cloud.
        action_mask: (B, horizon) bool, True = a step of the episode, False = its first or last one repeated.
        actions: the names of the signals that are actions.
    """

    clouds: PaddedClouds
    num_obs: int
    signals: Mapping[str, Any]
    action_mask: Tensor
    actions: Sequence[str] = ()

    @property
    def points(self) -> Tensor:
        """(B, T, M, 3) float32; zero where padded."""
        return self.field("points")

    @property
    def mask(self) -> Tensor:
        """(B, T, M) bool, True = a real point."""
        return self.clouds.mask.unflatten(0, (-1, self.num_obs))

    def field(self, name: str) -> Tensor:
        """Return a per-point field, (B, T, M, ...), such as "colors"; the memory is that of ``clouds``.

        Raises:
            DTypeError: the clouds do not have it.
        """
        fields = self.clouds.fields()
        if name not in fields:
            raise DTypeError(f"WindowBatch.field: the clouds have no field {name!r}; they have {', '.join(fields)}")
        return fields[name].unflatten(0, (-1, self.num_obs))

    def __len__(self) -> int:
        return len(self.clouds) // self.num_obs

    def __repr__(self) -> str:
        told = ", ".join(self.signals) or "no signals"
        return f"WindowBatch({len(self)} x {self.num_obs} of {self.clouds!r}: {told})"


def window_batch(where: str, windows: Sequence[PointCloud]) -> WindowBatch:
    """Put windows together; a cloud of no window is one of one cloud, without actions.

    Raises:
        ShapeError: they differ in their number of clouds, or in their actions.
    """
    clouds = PointCloud.cat_padded(windows)
    if isinstance(windows, Unbatched):
        sizes, num_obs = [windows.each] * len(windows), windows.each
        told = [dict(meta.get(WINDOW, {})) for meta in clouds.meta[::num_obs]]
    else:
        sizes, num_obs = [window.num_clouds for window in windows], windows[0].num_clouds
        told = [dict(window.meta[0].get(WINDOW, {})) for window in windows]
    actions = told[0].get("actions", [])
    for number, (size, its) in enumerate(zip(sizes, told, strict=True)):
        if size != num_obs or its.get("actions", []) != actions:
            raise ShapeError(
                f"{where}: window {number} has {size} clouds and the actions {its.get('actions', [])}, "
                f"window 0 {num_obs} and {actions}; give it samples of one EpisodeWindows"
            )
    newest = torch.arange(num_obs - 1, len(clouds), num_obs, dtype=torch.int64, device=clouds.device)
    signals: dict[str, Any] = {}
    now = signals_now(clouds)
    for name, signal in clouds.recorded_signals.items():
        if name in actions:
            signals[name] = now.of(name, newest)
        elif isinstance(signal.values, Tensor):
            signals[name] = now[name].unflatten(0, (-1, num_obs))
        else:
            signals[name] = tuple(signal.values[num_obs - 1 :: num_obs])
    horizon = signals[actions[0]].shape[1] if actions else 0
    step = torch.arange(horizon, dtype=torch.int64, device=clouds.device)
    real = torch.tensor([its.get("real", (0, 0)) for its in told], dtype=torch.int64, device=clouds.device)
    mask = (step >= real[:, :1]) & (step < real[:, 1:])
    return WindowBatch(clouds=clouds, num_obs=num_obs, signals=signals, action_mask=mask, actions=tuple(actions))
