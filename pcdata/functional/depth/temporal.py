"""The temporal filter of a depth stream, with its memory in the open."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner
from pcdata.contracts.tensors import check_tensors
from pcdata.errors import ConfigError, DTypeError
from pcdata.functional.depth.disparity import reciprocals

# librealsense's persistence rules: a pixel without a reading repeats its last value if it had at least `needed`
# readings in the last `frames` frames before this one.
PERSISTENCE_RULES: tuple[tuple[int, int], ...] = (
    (9, 8),  # 0: never (nine of eight cannot be)
    (8, 8),  # 1: valid in 8 of the last 8
    (2, 3),  # 2: valid in 2 of the last 3
    (2, 4),  # 3: valid in 2 of the last 4
    (2, 8),  # 4: valid in 2 of the last 8
    (1, 2),  # 5: valid in 1 of the last 2
    (1, 5),  # 6: valid in 1 of the last 5
    (1, 8),  # 7: valid in 1 of the last 8
    (0, 8),  # 8: always
)


@dataclass(frozen=True, eq=False, kw_only=True)
class TemporalState:
    """What the temporal filter remembers between two frames; made by the filter, passed back unchanged."""

    last: Tensor  # (V, H, W) float32: the last filtered value of every pixel, 0 = none yet
    history: Tensor  # (V, H, W) uint8: bit k is set if the pixel had a reading k + 1 frames ago

    def __post_init__(self) -> None:
        check_tensors(
            "TemporalState", {"last": self.last, "history": self.history},
            {"last": "V H W", "history": "V H W : uint8"},
        )  # fmt: skip


def temporal_filter(
    values: Tensor,  # (V, H, W) float32: disparity or depth, 0 = no reading
    state: TemporalState | None = None,
    *,
    alpha: float = 0.4,
    delta: float = 20.0,
    persistence: int = 3,
) -> tuple[Tensor, TemporalState]:  # values (V, H, W), and the state for the next frame
    """Average each pixel with its past while it changes little; bridge short losses of the reading.

    A reading that differs by less than ``delta`` from the last value becomes ``alpha`` of itself and the rest of the
    last value; any other reading is taken as it is, and the pixel's history starts anew. A pixel without a reading
    repeats its last value where the persistence rule holds for its history before this frame; it counts as missing
    all the same.

    Args:
        values: the frame; the same V views of the same size in every call.
        state: what the previous call returned; None = first frame.
        alpha: weight of the new reading, above 0 to 1; 1 = no averaging.
        delta: the smallest change that is another surface, in the unit of the values.
        persistence: 0..8, see :data:`PERSISTENCE_RULES`.

    Raises:
        ConfigError: a parameter out of range.
        ShapeError, DeviceError: the state belongs to other images.
        CaptureError: a negative value.

    Source: librealsense, temporal filter.
    """
    where = "temporal_filter"
    if not 0 < alpha <= 1 or not delta > 0 or persistence not in range(len(PERSISTENCE_RULES)):
        raise ConfigError(
            f"{where}: needs 0 < alpha <= 1, delta > 0 and persistence 0..8, got {alpha}, {delta}, {persistence!r}"
        )
    check_tensors(where, {"values": values}, {"values": "V H W : depth"})
    state = checked_state(where, "values", values, state)
    filtered, last, seen = temporal_step(values, None, state.last, state.history, alpha, delta, persistence)
    return filtered, TemporalState(last=last, history=seen)


def checked_state(where: str, name: str, values: Tensor, state: TemporalState | None) -> TemporalState:
    """Return the state, which must be of these images; of None, that of a stream's beginning.

    Raises:
        DTypeError: it is none.
        ShapeError, DeviceError: it belongs to other images.
    """
    if state is None:
        history = torch.zeros_like(values, dtype=torch.uint8)
        return TemporalState(last=torch.zeros_like(values), history=history)
    if not isinstance(state, TemporalState):
        raise DTypeError(f"{where}: state must be what the call before returned, or None, not {type(state).__name__}")
    given = {name: values, "last": state.last, "history": state.history}
    check_tensors(
        where, given, {name: "V H W : float32", "last": "V H W", "history": "V H W : uint8"}, check_values=False
    )
    return state


@inner
def temporal_step(
    values: Tensor,
    scale: Tensor | None,
    last: Tensor,
    history: Tensor,
    alpha: float,
    delta: float,
    persistence: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what :func:`temporal_filter` gives, and the ``last`` and ``history`` after it.

    Args:
        values: (V, H, W) float32, 0 = no reading; none negative.
        scale: (V,) float32: values are depths; ``scale / depth`` is filtered and remembered, and turned back. None =
            they are as they are.
        last: of the state before.
        history: of the state before.
        alpha: as there.
        delta: as there.
        persistence: as there.
    """
    if scale is not None:
        values = reciprocals(values, scale)
        disparity, last, seen = temporal_step(values, None, last, history, alpha, delta, persistence)
        return reciprocals(disparity, scale), last, seen
    valid = values > 0
    steady = valid & (last > 0) & ((values - last).abs() < delta)
    # Not lerp, which rounds once or twice as the processor has it.
    filtered = torch.where(steady, values + (1 - alpha) * (last - values), values)
    remembered = ~valid & (last > 0) & _credible(history, *PERSISTENCE_RULES[persistence])
    # A surface that has just appeared cannot lean on the history of the one before it.
    past = torch.where(steady | ~valid, history << 1, 0)
    seen = past | valid.to(torch.uint8)
    return torch.where(remembered, last, filtered), torch.where(valid, filtered, last), seen


def _credible(history: Tensor, needed: int, frames: int) -> Tensor:
    """Say where at least ``needed`` of the lowest ``frames`` bits are set."""
    window = history & ((1 << frames) - 1)
    if needed > frames:
        return torch.zeros_like(window, dtype=torch.bool)
    if needed == frames:
        return window == (1 << frames) - 1
    for _ in range(needed - 1):
        window = window & (window - 1)  # clears the lowest set bit
    return torch.ones_like(window, dtype=torch.bool) if needed == 0 else window != 0
