"""Range images of spinning lidars: points to pixels and back.

A direction is placed by arithmetic alone, so that every backend decides alike: its elevation and its azimuth are
compared with the borders between pixels by quotients that rise with them, ``z / (sqrt(x^2 + y^2) + |z|)`` and
``x / (|x| + |y|)``.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_image_size
from pcdata.contracts.on_host import read_together, uploaded
from pcdata.errors import ConfigError
from pcdata.functional.rendering import RenderedPoints, in_front
from pcdata.functional.rows import cloud_of_rows, ptr_from_counts, rows_of_mask
from pcdata.geometry.roots import square_root

_NOWHERE = 2.0  # a border that no quotient reaches


@op(points="N 3", ptr="ptr N V", size=checked_image_size, gradient=False)
def render_ranges(
    points: Tensor,  # (N, 3) float32 metres in the frame of the lidar: x forward, y left, z up
    ptr: Tensor | None = None,  # (V+1,)
    *,
    size: tuple[int, int],  # (beams, columns of a turn)
    elevations: tuple[float, float] = (-0.4363, 0.0524),
    backend: str = "auto",
) -> RenderedPoints:
    """Render every cloud as the range image of a spinning lidar: at each pixel the nearest point's distance.

    Row 0 looks up most. Rows are equal steps of the elevation from ``elevations[1]`` down to ``elevations[0]``, their
    centers at both ends; column 0 is straight back and columns turn clockwise seen from above (left to right as the
    sensor looks), their centers half a step in. Points between rows belong to the nearest one; those more than half a
    step beyond the outer rows, and those at distance 0, are left out. Ranges are float32, 0 = nothing.

    Args:
        points: the clouds.
        ptr: row pointers of the points.
        size: beams and columns.
        elevations: of the lowest and highest beam in radians; the default is that of an HDL-64E.
        backend: which body to run.

    Raises:
        ConfigError: a size below one pixel, or elevations that do not ascend within a quarter turn.

    Source: Milioto et al., RangeNet++, 2019, section III-A, with beams at pixel centers.
    """
    assert ptr is not None
    beams, columns = size
    row_borders, column_borders = (
        uploaded(part, points.device) for part in pixel_borders("render_ranges", size, elevations)
    )
    x, y, z = points.double().unbind(-1)
    flat, distance = square_root(x * x + y * y), square_root((x * x + y * y) + z * z).float()
    row = torch.searchsorted(row_borders, -z / (flat + z.abs()), right=True) - 1
    across = x.abs() + y.abs()
    turn = torch.where(across > 0, x / across, 1.0)  # straight up is where straight ahead is
    column = torch.searchsorted(column_borders, torch.where(y >= 0, turn + 1, 3 - turn), right=True)
    seen = ((distance > 0) & (row >= 0) & (row < beams)).nonzero().squeeze(1)
    target = (cloud_of_rows(ptr) * beams + row) * columns + column
    return in_front(distance, [(seen, target[seen])], (len(ptr) - 1, beams, columns))


@op(ranges="V H W : depth")
def deproject_ranges(
    ranges: Tensor,  # (V, H, W) float32 metres along the beam, 0 = no reading
    *,
    elevations: tuple[float, float] = (-0.4363, 0.0524),
    backend: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:  # points (M, 3) float32, ptr (V+1,), pixel_index (M,) int64
    """Turn the range images of a spinning lidar into points, at the centers of their pixels: x forward, y left, z up.

    The way back of :func:`render_ranges`: a cloud of one point per pixel comes back to half a pixel.

    Raises:
        CaptureError: a negative range.
        ConfigError: elevations that do not ascend within a quarter turn.
    """
    beams, columns = ranges.shape[1:]
    rows, turns = (
        uploaded(part, ranges.device) for part in pixel_turns("deproject_ranges", (beams, columns), elevations)
    )
    up, across = rows[:, None], turns.expand(beams, -1, -1)
    directions = torch.stack(
        [up[..., 0] * across[..., 0], up[..., 0] * across[..., 1], up[..., 1].expand(-1, columns)], dim=-1
    )
    valid = ranges > 0
    (counts,) = read_together([valid.sum(dim=(1, 2))])
    rows = rows_of_mask(valid.flatten(), sum(counts))
    pixel = rows % (beams * columns)
    points = (directions.flatten(0, 1)[pixel] * ranges.flatten()[rows].double()[:, None]).float()
    return points, ptr_from_counts(counts, ranges.device), pixel


def pixel_borders(
    where: str, size: tuple[int, int], elevations: tuple[float, float]
) -> tuple[Tensor, Tensor]:  # rows (beams+1,), columns (columns-1,) float64, rising, on the CPU
    """Return the quotients at which a direction passes from one row, and one column, to the next.

    Raises:
        ConfigError: elevations that do not ascend within a quarter turn.
    """
    beams, columns = size
    low, high = _checked_elevations(where, elevations)
    border = high - (np.arange(beams + 1) - 0.5) * ((high - low) / max(1, beams - 1))
    up = np.sin(border)
    rows = np.where(np.abs(border) < math.pi / 2, -up / (np.cos(border) + np.abs(up)), -_NOWHERE * np.sign(border))
    turned = np.arange(1, columns) * (2 * math.pi / columns)  # from straight back
    x, y = -np.cos(turned), np.sin(turned)
    share = x / (np.abs(x) + np.abs(y))
    return torch.from_numpy(rows), torch.from_numpy(np.where(y >= 0, share + 1, 3 - share))


def pixel_turns(
    where: str, size: tuple[int, int], elevations: tuple[float, float]
) -> tuple[Tensor, Tensor]:  # rows (beams, 2), columns (columns, 2) float64, on the CPU
    """Return cosine and sine of the elevation of every row and of the azimuth of every column, at their centers.

    Raises:
        ConfigError: elevations that do not ascend within a quarter turn.
    """
    beams, columns = size
    low, high = _checked_elevations(where, elevations)
    elevation = high - np.arange(beams) * ((high - low) / max(1, beams - 1))
    azimuth = math.pi - (np.arange(columns) + 0.5) * (2 * math.pi / columns)
    rows, turns = (np.stack([np.cos(angle), np.sin(angle)], axis=1) for angle in (elevation, azimuth))
    return torch.from_numpy(rows), torch.from_numpy(turns)


def _checked_elevations(where: str, elevations: tuple[float, float]) -> tuple[float, float]:
    low, high = elevations
    if not -math.pi / 2 <= low < high <= math.pi / 2:
        raise ConfigError(f"{where}: elevations must ascend within -pi/2 .. pi/2 radians, got {elevations}")
    return float(low), float(high)
