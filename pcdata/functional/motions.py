"""Random motions of clouds, and the way back through motions: the same bits on every processor and in any batch.

By sums, products and quotients alone, in one order; no library's sine, and no library's inverse where a plain one is as
good.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner
from pcdata.rng import words

ENTRY, SIGN, TURN = range(3)  # what a row of a table of draws is

# Of sine and cosine within an eighth of a turn: their Taylor series, which leave less than 1e-18 there.
SINE = tuple((-1) ** k / math.factorial(2 * k + 1) for k in range(9))
COSINE = tuple((-1) ** k / math.factorial(2 * k) for k in range(10))
# A quarter turn as two numbers, the first of 33 bits: its multiples by a few are exact.
QUARTER, QUARTER_REST = 1.57079632673412561417e00, 6.07710050650619224932e-11
QUARTERS = 0.63661977236758134308  # in a radian

PLAIN_LENGTHS = 1e-50, 1e50  # of the largest entry of a linear part
PLAIN_DETERMINANT = 1e-3  # of a linear part divided by its largest entry: from here on its inverse is as good as LU's

# What is drawn of a word of each cloud's stream, (step, word, kind, low, high, a, b, c); u is the word as a number in
# [0, 1), and v = low + (high - low) u:
#   ENTRY  the matrix has v at row a, column b
#   SIGN   it has -1 on its diagonal at a if u < low, else 1
#   TURN   its linear part is turned further, about the unit axis (a, b, c), by v radians
MotionDraw = tuple[int, int, int, float, float, float, float, float]


@inner
def draw_motions(
    keys: Tensor,  # (B,) int64, of streams that begin with word 0
    draws: Tensor,  # (R, 8) float64, a MotionDraw each
    num_steps: int,
) -> Tensor:
    """Return (S, B, 4, 4) float64 matrices, drawn in the order of the rows; what is not drawn is the identity."""
    matrices = torch.eye(4, dtype=torch.float64, device="cpu").repeat(num_steps, len(keys), 1, 1)
    for step, word, kind, low, high, a, b, c in draws.tolist():
        matrix = matrices[int(step)]
        number = torch.tensor([int(word)], dtype=torch.int64, device="cpu")
        unit = ((words(keys, number) >> 11) & ((1 << 53) - 1)).double() * 2.0**-53
        value = low + (high - low) * unit
        if kind == ENTRY:
            matrix[:, int(a), int(b)] = value
        elif kind == SIGN:
            matrix[:, int(a), int(a)] = torch.where(unit < low, -1.0, 1.0).double()
        else:
            matrix[:, :3, :3] = _product(_turned_about((a, b, c), value), matrix[:, :3, :3])
    return matrices


def sine_and_cosine(angle: Tensor) -> tuple[Tensor, Tensor]:
    """Return those of (...) float64 angles of a few turns at most, within a bit or two."""
    quarter = torch.round(angle * QUARTERS)
    rest = (angle - quarter * QUARTER) - quarter * QUARTER_REST
    square = rest * rest
    sine, cosine = _polynomial(SINE, square) * rest, _polynomial(COSINE, square)
    turns = quarter.long()
    is_odd, is_far = (turns & 1) == 1, (turns & 2) == 2
    one, other = torch.where(is_odd, cosine, sine), torch.where(is_odd, sine, cosine)
    return torch.where(is_far, -one, one), torch.where(is_far != is_odd, -other, other)


def _polynomial(coefficients: Sequence[float], x: Tensor) -> Tensor:
    value = torch.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = value * x + coefficient
    return value


def _turned_about(axis: tuple[float, float, float], angle: Tensor) -> Tensor:
    """Return (B, 3, 3) rotations about a unit axis.

    Source: Rodrigues' formula, with the square of the cross product's matrix written out.
    """
    x, y, z = axis
    cross = ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))
    square = ((-(y * y + z * z), x * y, x * z), (x * y, -(x * x + z * z), y * z), (x * z, y * z, -(x * x + y * y)))
    sine, cosine = sine_and_cosine(angle)
    rest = 1.0 - cosine
    rows = [
        torch.stack([(float(i == j) + sine * cross[i][j]) + rest * square[i][j] for j in range(3)], dim=-1)
        for i in range(3)
    ]
    return torch.stack(rows, dim=-2)


def _product(one: Tensor, other: Tensor) -> Tensor:
    """Return (B, I, 3) times (B, 3, 3), each sum from the left."""
    terms = one[:, :, :, None] * other[:, None, :, :]
    return (terms[:, :, 0] + terms[:, :, 1]) + terms[:, :, 2]


@inner
def led_back(
    source_from_cloud: Tensor,  # (B, 4, 4) float64
    matrices: Tensor,  # (S, B, 4, 4) float64, affine: new_from_old of one motion after another
) -> Tensor:
    """Return (B, 4, 4) that lead back to the source from behind the motions: times the inverse of each, in turn."""
    for matrix in matrices:
        linear, shift = matrix[:, :3, :3], matrix[:, :3, 3]
        turned = _product(source_from_cloud[:, :, :3], inverse_linear(linear))
        moved = turned * shift[:, None, :]
        place = source_from_cloud[:, :, 3] - ((moved[:, :, 0] + moved[:, :, 1]) + moved[:, :, 2])
        source_from_cloud = torch.cat([turned, place[:, :, None]], dim=2)
    return source_from_cloud


@inner
def are_plain_motions(matrices: Tensor) -> bool:
    """Whether all (..., 4, 4) float64 matrices are finite, have the last row 0 0 0 1, and are far from being flat."""
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64, device=matrices.device)
    largest, _, determinant = _scaled_cofactors(matrices[..., :3, :3])
    fits = torch.isfinite(matrices).all() & (matrices[..., 3, :] == last).all()
    fits &= ((largest >= PLAIN_LENGTHS[0]) & (largest <= PLAIN_LENGTHS[1])).all()
    return bool(fits & (determinant.abs() >= PLAIN_DETERMINANT).all())


def inverse_linear(linear: Tensor) -> Tensor:
    """Return the inverses of (B, 3, 3) float64 matrices: by cofactors, or by LU those that are nearly flat."""
    largest, adjugate, determinant = _scaled_cofactors(linear)
    inverse = adjugate / determinant[:, None, None] / largest
    is_plain = (determinant.abs() >= PLAIN_DETERMINANT)[:, None, None]
    if bool(is_plain.all()):
        return inverse
    identity = torch.eye(3, dtype=linear.dtype, device=linear.device)
    return torch.where(is_plain, inverse, torch.linalg.inv(torch.where(is_plain, identity, linear)))


def _scaled_cofactors(linear: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the largest entry of (..., 3, 3), and the adjugate and the determinant of what they are times that."""
    largest = linear.abs().amax((-2, -1), keepdim=True)
    (a, b, c), (d, e, f), (g, h, i) = ((one for one in row.unbind(-1)) for row in (linear / largest).unbind(-2))
    cofactors = [
        [e * i - f * h, c * h - b * i, b * f - c * e],
        [f * g - d * i, a * i - c * g, c * d - a * f],
        [d * h - e * g, b * g - a * h, a * e - b * d],
    ]
    determinant = (a * cofactors[0][0] + b * cofactors[1][0]) + c * cofactors[2][0]
    return largest, torch.stack([torch.stack(row, dim=-1) for row in cofactors], dim=-2), determinant
