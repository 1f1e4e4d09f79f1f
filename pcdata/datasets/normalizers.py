"""What networks are fed instead of raw numbers: each channel moved and scaled by its range, or its mean and spread.

The formulas are those of diffusion policy's ``LinearNormalizer``, which DP3 uses too, over every step of the episodes
once and without padding.

Source: real-stanford/diffusion_policy, ``diffusion_policy/model/common/normalizer.py``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from pcdata.datasets.samples import SampleDataset
from pcdata.datasets.window_batch import WindowBatch
from pcdata.datasets.windows import EpisodeWindows
from pcdata.errors import ConfigError, DTypeError, NonFiniteError, ShapeError, near_matches
from pcdata.structures import PaddedClouds, PointCloud
from pcdata.structures.structure import Structure
from pcdata.structures.unbatched import Unbatched

Mode = Literal["limits", "gaussian"]

_FLAT = 1e-4  # a channel that varies less is moved and not scaled


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearNormalizer(Structure):
    """``scale * x + offset`` for each of C channels, and back; made by :func:`fit_normalizers`.

    Args:
        scale: (C,) float32.
        offset: (C,) float32.
        minimum: (C,) float32 of the data that it was fitted to, and so on.
        maximum: (C,) float32.
        mean: (C,) float32.
        std: (C,) float32, of the sample (divided by n - 1).
    """

    scale: Tensor
    offset: Tensor
    minimum: Tensor
    maximum: Tensor
    mean: Tensor
    std: Tensor

    def normalize(self, values: Tensor) -> Tensor:
        """Return (..., C) values as the network is fed them."""
        return values * self.scale + self.offset

    def unnormalize(self, values: Tensor) -> Tensor:
        """Return (..., C) values of the network in the units of the data."""
        return (values - self.offset) / self.scale


def fit_normalizers(
    data: SampleDataset | Iterable[Any], names: Sequence[str] | None = None, *, mode: Mode = "limits"
) -> dict[str, LinearNormalizer]:
    """Fit one normalizer for the points, and one for each signal, in the coordinates that the clouds are given in.

    Padding counts for nothing: of :class:`EpisodeWindows` every step of the episodes counts once, however often windows
    repeat it; of padded batches the real points and steps alone count, and of points what sampling with
    ``if_short: zeros`` added does not.

    Args:
        data: a dataset, a stream of one, or batches as a loader gives them; it is gone through once.
        names: "points", per-point fields and signals; None = the points and every signal that is numbers.
        mode: "limits" maps the range of each channel to -1..1; "gaussian" the mean to 0 and the standard deviation
            to 1. A channel that stays within 1e-4 is moved to the middle and not scaled.

    Raises:
        ConfigError: another mode, or nothing to fit to.
        DTypeError: there is no such field or signal, it is no numbers, or two have one name.
        ShapeError: the number of channels changes.
        NonFiniteError: points or fields have NaN or infinite values.
    """
    if mode not in ("limits", "gaussian"):
        raise ConfigError(f"fit_normalizers: mode must be 'limits' or 'gaussian', got {mode!r:.100}")
    totals: dict[str, _Total] = {}
    for sample in _once(data):
        fields, signals = _values(sample)
        if twice := sorted(fields.keys() & signals.keys()):
            raise DTypeError(f"fit_normalizers: {twice} are fields and signals of one name; give the signals others")
        for name in _wanted(fields, signals, names):
            totals.setdefault(name, _Total(name)).add({**fields, **signals}[name])
    if not totals or not all(total.count for total in totals.values()):
        raise ConfigError(f"fit_normalizers: {data!r:.200} has no values to fit to")
    return {name: total.normalizer(mode) for name, total in totals.items()}


def _once(data: Any) -> Iterator[Any]:
    if not isinstance(data, EpisodeWindows):
        for one in data:
            yield from one.batches if isinstance(one, Unbatched) else (one,)
        return
    for episode in data.episodes:
        if episode.id not in data.skipped:
            for place in episode.steps:
                yield data.dataset[place]


def _values(sample: Any) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return fields (N, ...) and signals (..., C) of a sample or a batch, without what is padding."""
    if isinstance(sample, WindowBatch):
        return _values_of_windows(sample)
    if isinstance(sample, PaddedClouds):
        fields = {name: values[sample.mask] for name, values in sample.fields().items()}
    elif isinstance(sample, PointCloud):
        fields = sample.fields()
    else:
        raise DTypeError(f"fit_normalizers: takes clouds or batches of them, got {type(sample).__name__}")
    return _without_added(fields), dict(sample.signals)


def _values_of_windows(batch: WindowBatch) -> tuple[dict[str, Tensor], dict[str, Any]]:
    steps = batch.action_mask  # of every step of a window, those observed first
    shown = steps[:, : batch.num_obs] if steps.shape[1] >= batch.num_obs else steps.new_ones(len(batch), batch.num_obs)
    real = batch.clouds.mask & shown.flatten()[:, None]
    fields = {name: values[real] for name, values in batch.clouds.fields().items()}
    signals = {
        name: values[steps if name in batch.actions else shown] if isinstance(values, Tensor) else values
        for name, values in batch.signals.items()
    }
    return _without_added(fields), signals


def _without_added(fields: dict[str, Tensor]) -> dict[str, Tensor]:
    """Leave out the points that sampling added to short clouds."""
    if "source_index" not in fields:
        return fields
    real = fields["source_index"] >= 0
    return {name: values[real] for name, values in fields.items()}


def _wanted(fields: dict[str, Tensor], signals: dict[str, Any], names: Sequence[str] | None) -> list[str]:
    numbers = [*fields, *(name for name, value in signals.items() if isinstance(value, Tensor))]
    if names is None:
        return ["points", *(name for name in numbers[len(fields) :] if signals[name].shape[-1:] != (0,))]
    for name in names:
        if name not in numbers:
            raise DTypeError(
                f"fit_normalizers: there are no numbers called {name!r}{near_matches(str(name), numbers)}; there are "
                f"{', '.join(numbers)}"
            )
    return list(names)


class _Total:
    """Range, mean and spread of C channels, in float64 as they come by.

    Source: Chan, Golub & LeVeque, Updating formulae and a pairwise algorithm for computing sample variances, 1979.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.count = 0
        self.mean = self.squares = self.low = self.high = torch.zeros(0, dtype=torch.float64, device="cpu")

    def add(self, values: Tensor) -> None:
        if values.ndim > 1 and values.shape[-1] == 0:
            raise ShapeError(f"fit_normalizers: {self.name!r} has no channels; leave it out of names")
        rows = values.detach().reshape(-1, values.shape[-1] if values.ndim > 1 else 1).double().cpu()
        if not len(rows):
            return
        if not bool(torch.isfinite(rows).all()):
            raise NonFiniteError(f"fit_normalizers: {self.name!r} has NaN or infinite values; leave those out before")
        if self.count and rows.shape[1] != len(self.mean):
            raise ShapeError(f"fit_normalizers: {self.name!r} has {rows.shape[1]} channels, before {len(self.mean)}")
        count, mean = len(rows), rows.mean(0)
        squares = (rows - mean).square().sum(0)
        if self.count:
            total, apart = self.count + count, mean - self.mean
            squares = self.squares + squares + apart.square() * (self.count * count / total)
            mean = self.mean + apart * (count / total)
        self.low = torch.minimum(self.low, rows.amin(0)) if self.count else rows.amin(0)
        self.high = torch.maximum(self.high, rows.amax(0)) if self.count else rows.amax(0)
        self.count, self.mean, self.squares = self.count + count, mean, squares

    def normalizer(self, mode: Mode) -> LinearNormalizer:
        std = (self.squares / max(1, self.count - 1)).sqrt()
        if mode == "limits":
            extent = self.high - self.low
            flat = extent < _FLAT
            scale = 2 / torch.where(flat, 2.0, extent)
            offset = torch.where(flat, -self.low, -1 - scale * self.low)
        else:
            scale = 1 / torch.where(std < _FLAT, 1.0, std)
            offset = -self.mean * scale
        told = {"minimum": self.low, "maximum": self.high, "mean": self.mean, "std": std}
        return LinearNormalizer(
            scale=scale.float(), offset=offset.float(), **{name: value.float() for name, value in told.items()}
        )
