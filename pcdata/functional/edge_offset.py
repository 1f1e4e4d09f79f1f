"""How far a colour image is off its depth image, measured where near surfaces end.

A registered colour image changes colour where depth jumps. Along the normal of every rim the colour steps around it
vote for an offset; offsets of a rim with normal n are ``shift . n + bias``. The shift moves the left rim of an object
inwards and the right one outwards; the bias moves all outwards or inwards, as sensors do that make objects fatter
or thinner, so the two can be told apart wherever an object shows both of two opposite sides.

Votes are kept per direction of the rim, so they add up over the frames of a recording in constant memory, and the
score of every (shift, bias) is a sum over these few histograms, as in a Radon transform.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from pcdata.checks import check_tensors
from pcdata.functional.occlusion_edges import occlusion_edges, resolution_scale

SHIFT_LIMIT = 12  # pixels: shifts up to this far, along either axis, are looked for
TELLABLE = 3.0  # pixels: a shift that must not go unnoticed; an answer less sure than this is none
NUM_GROUPS = 8  # parts of the image that vote apart; leaving out one at a time tells how sure the answer is
_BIAS_LIMIT = 4  # pixels at 640 pixels width; stereo matchers smear an object's rim by half their window
_NUM_DIRECTIONS = 24  # 15 degrees each: a shift of 12 pixels is blurred by less than 12 sin 7.5 degrees = 1.6
_GRID_STEP = 1.5  # pixels; the votes are blurred by as much, so nothing falls between two grid points
_BLUR = 1.5  # pixels, standard deviation: how ragged rims are
_BIAS_COST = 0.05  # of the score of chance, per pixel: of equal answers, the one with the smaller bias
_COLOR_NOISE = 12.0  # grey levels of 255: colour steps below this are noise and compression
_NOISE_STEPS = 4  # steps of that height, summed along a normal, have half a vote
_MIN_EDGES = 150  # rim points; fewer come from a single small object
_LEAST_SPREAD = 0.25  # pixels: nobody knows a shift better than that from rims of whole pixels


@dataclass(frozen=True)
class EdgeVotes:
    """Votes for the offset between colour and depth, of one frame or summed over many."""

    histogram: Tensor  # (NUM_GROUPS, 24, T) float32: part of the image, direction of the rim, offset along its normal
    num_edges: int
    scale: int  # of the image's resolution

    def __add__(self, other: EdgeVotes) -> EdgeVotes:
        """Sum the votes of two frames of one camera."""
        return EdgeVotes(self.histogram + other.histogram, self.num_edges + other.num_edges, self.scale)


@dataclass(frozen=True)
class EdgeOffset:
    """The shift that brings depth onto colour: what is at pixel p in depth is at ``p + shift`` in colour."""

    shift: tuple[float, float]  # pixels, (right, down)
    spread: tuple[float, float]  # pixels: how far each component may be off
    bias: float  # pixels by which the colour rims lie outside the depth rims, all around
    num_edges: int
    problem: str | None  # why the shift cannot be trusted at all; None = it can, within its spread

    @property
    def length(self) -> float:
        """The length of the shift in pixels."""
        return math.hypot(*self.shift)

    @property
    def least_length(self) -> float:
        """The length of the shortest shift within the spread."""
        return math.hypot(*(max(0.0, abs(one) - off) for one, off in zip(self.shift, self.spread)))

    @property
    def greatest_length(self) -> float:
        """The length of the longest shift within the spread."""
        return math.hypot(*(abs(one) + off for one, off in zip(self.shift, self.spread)))


def edge_votes(
    depth: Tensor,  # (H, W) float32, metres, 0 = no reading
    colors: Tensor,  # (H, W, 3) uint8
) -> EdgeVotes:
    """Let every rim point of the depth image vote for the offsets at which the colour changes along its normal.

    A point has one vote, shared by the colour steps along its normal in proportion to the square of their height, so
    one bright sticker does not outvote a hundred plain rims. Pixels that are pure black are no image (a colour image
    that was warped onto the depth has them where there is no depth) and do not vote.
    """
    check_tensors("edge_votes", {"depth": depth, "colors": colors}, {"depth": "H W", "colors": "H W 3 : uint8"})
    scale = resolution_scale(depth.shape[1])
    reach = SHIFT_LIMIT + _BIAS_LIMIT * scale
    position, normal = occlusion_edges(depth, margin=reach + scale + 1)
    along = torch.arange(-reach - scale, reach + scale + 1, device=depth.device, dtype=depth.dtype)
    pixels = (position[:, None] + along[:, None] * normal[:, None]).round().long()
    samples = colors[pixels[..., 1], pixels[..., 0]].to(depth.dtype)
    step = (samples[:, 2 * scale :] - samples[:, : -2 * scale]).abs().amax(2)
    empty = (samples == 0).all(2)
    step = step.masked_fill(empty[:, 2 * scale :] | empty[:, : -2 * scale], 0.0)
    power = step.square()
    votes = power / (power.sum(1, keepdim=True) + _NOISE_STEPS * _COLOR_NOISE**2)

    turn = torch.atan2(normal[:, 1], normal[:, 0]) / (2 * math.pi)
    direction = (turn * _NUM_DIRECTIONS).round().long() % _NUM_DIRECTIONS
    block = (position / max(depth.shape[1] // 8, 1)).long()
    group = (3 * block[:, 1] + block[:, 0]) % NUM_GROUPS  # neighbouring blocks, and those of one column, fall apart
    histogram = votes.new_zeros(NUM_GROUPS * _NUM_DIRECTIONS, votes.shape[1])
    histogram.index_add_(0, group * _NUM_DIRECTIONS + direction, votes)
    return EdgeVotes(histogram.view(NUM_GROUPS, _NUM_DIRECTIONS, -1), len(position), scale)


def offset_from_votes(votes: EdgeVotes) -> EdgeOffset:
    """Return the shift that most votes agree on, and how far it may be off.

    The spread is the jackknife's: twice the standard error from leaving out one part of the image at a time. Where
    an axis shows rims of one side only (the tops of objects that stand on a table, say), shift and bias cannot be
    told apart along it, so the bias adds to the spread.

    Source: Efron & Stein, The Jackknife Estimate of Variance, 1981.
    """
    if votes.num_edges < _MIN_EDGES:
        too_few = f"only {votes.num_edges} points on the rims of near surfaces, {_MIN_EDGES} are needed"
        return EdgeOffset((0.0, 0.0), (math.inf, math.inf), 0.0, votes.num_edges, too_few)
    histogram = _blurred(votes.histogram)
    scores = torch.stack([_scores(part, votes.scale) for part in histogram])  # (G, X, Y, B), linear in the votes
    chance = histogram.mean(2).sum(1)  # (G,) the score of an offset that nothing speaks for
    total, all_chance = scores.sum(0), chance.sum().clamp_min(1e-9)
    shift, bias, at_border = _best(total / all_chance, votes.scale)
    without_one = [
        _best((total - part) / (all_chance - share).clamp_min(1e-9), votes.scale)[0]
        for part, share in zip(scores, chance)
    ]
    deviation = torch.tensor(without_one) - torch.tensor(without_one).mean(0)
    error = (deviation.square().sum(0) * (NUM_GROUPS - 1) / NUM_GROUPS).sqrt()
    one_sided = 1.0 - _balance(votes.histogram).cpu()
    spread = (2.0 * error).clamp_min(_LEAST_SPREAD) + abs(bias) * one_sided
    problem: str | None = None
    if bool((2.0 * error > TELLABLE).any()):
        problem = f"parts of the image disagree by more than {TELLABLE:g} pixels"
    if at_border:
        problem = f"no shift of up to {SHIFT_LIMIT} pixels brings the rims of near surfaces onto edges of the colour"
    elif abs(bias) >= _BIAS_LIMIT * votes.scale:
        problem = f"depth and colour disagree by {abs(bias):g} pixels or more on how large the objects are"
    return EdgeOffset(shift, (float(spread[0]), float(spread[1])), bias, votes.num_edges, problem)


def _blurred(histogram: Tensor) -> Tensor:
    """Blur the votes along the offset, so that ragged rims agree."""
    reach = math.ceil(3 * _BLUR)
    taps = torch.arange(-reach, reach + 1, device=histogram.device, dtype=histogram.dtype)
    weights = torch.exp(-0.5 * (taps / _BLUR).square())
    weights = (weights / weights.sum())[None, None]
    flat = histogram.reshape(-1, 1, histogram.shape[-1])
    padded = torch.nn.functional.pad(flat, (reach, reach), mode="replicate")
    return torch.nn.functional.conv1d(padded, weights).reshape(histogram.shape)


@cache
def _grid(scale: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return shifts (S,), biases (B,), and where in a histogram each (shift x, shift y, bias, direction) falls."""
    shifts = torch.arange(-SHIFT_LIMIT, SHIFT_LIMIT + 0.1, _GRID_STEP)
    biases = torch.arange(-_BIAS_LIMIT, _BIAS_LIMIT + 0.1, 0.5) * scale
    angle = torch.arange(_NUM_DIRECTIONS) * (2 * math.pi / _NUM_DIRECTIONS)
    offset = shifts[:, None, None, None] * angle.cos() + shifts[:, None, None] * angle.sin() + biases[:, None]
    place = offset + (SHIFT_LIMIT + _BIAS_LIMIT * scale)
    return shifts, biases, place.floor().long(), place - place.floor()


def _scores(histogram: Tensor, scale: int) -> Tensor:
    """Return how many votes agree with every (shift x, shift y, bias); offsets nobody could vote for score chance."""
    _, _, low, fraction = (one.to(histogram.device) for one in _grid(scale))
    chance = histogram.mean(1, keepdim=True)
    last = histogram.shape[1] - 1
    # One column of chance on either side: where both neighbours lie outside, so does the score.
    padded = torch.cat([chance, histogram, chance], dim=1)
    row = torch.arange(_NUM_DIRECTIONS, device=histogram.device) * padded.shape[1]
    below = (low + 1).clamp(0, last + 2) + row
    above = (low + 2).clamp(0, last + 2) + row
    flat = padded.reshape(-1)
    return torch.lerp(flat[below], flat[above], fraction).sum(-1)


def _best(score: Tensor, scale: int) -> tuple[tuple[float, float], float, bool]:
    """Return the best shift to a fraction of the grid step, its bias, and whether it lies on the grid's border."""
    shifts, biases, _, _ = (one.to(score.device) for one in _grid(scale))
    score = score - _BIAS_COST * biases.abs() / scale
    over_bias, which = score.max(2)
    across, down = divmod(int(over_bias.argmax()), len(shifts))
    x = float(shifts[across]) + _GRID_STEP * _vertex(over_bias[:, down], across)
    y = float(shifts[down]) + _GRID_STEP * _vertex(over_bias[across], down)
    at_border = not (0 < across < len(shifts) - 1 and 0 < down < len(shifts) - 1)
    return (x, y), float(biases[which[across, down]]), at_border


def _vertex(values: Tensor, peak: int) -> float:
    """Return where the parabola through a peak and its neighbours is highest, relative to the peak."""
    if not 0 < peak < len(values) - 1:
        return 0.0
    left, middle, right = values[peak - 1 : peak + 2].tolist()
    bend = left - 2 * middle + right
    return 0.5 * (left - right) / bend if bend < 0 else 0.0


def _balance(histogram: Tensor) -> Tensor:
    """Return, for either axis, the votes of the weaker side over those of the stronger one: (2,), 0 = one side only."""
    weight = histogram.sum((0, 2))
    angle = torch.arange(_NUM_DIRECTIONS, device=weight.device) * (2 * math.pi / _NUM_DIRECTIONS)
    toward = torch.stack([angle.cos(), angle.sin()])
    ahead = (toward.clamp_min(0).square() * weight).sum(1)
    behind = (toward.clamp_max(0).square() * weight).sum(1)
    return torch.minimum(ahead, behind) / torch.maximum(ahead, behind).clamp_min(1e-9)
