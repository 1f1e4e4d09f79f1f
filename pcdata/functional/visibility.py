"""Which points a camera sees: those in its view, and those that nothing before them hides."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.contracts.dispatch import op
from pcdata.contracts.numbers import checked_image_size, checked_places, checked_positive
from pcdata.contracts.on_host import bounds_of
from pcdata.errors import ConfigError
from pcdata.functional.depth.deproject import projected
from pcdata.functional.equal_rows import numbered_rows
from pcdata.functional.hulls import hull_surface


def _checked_near(where: str, name: str, arguments: Mapping[str, Any]) -> float:
    value = arguments[name]
    return 0.0 if value == 0 and not isinstance(value, bool) else checked_positive(where, name, arguments)


def _checked_far(where: str, name: str, arguments: Mapping[str, Any]) -> float:
    far = checked_positive(where, name, arguments, finite=False)
    near = _checked_near(where, "near", arguments)
    if not near < far:
        raise ConfigError(f"{where}: near must be below far, got near={near}, far={far}")
    return far


@op(
    points="N 3 : float",
    ptr="ptr N V",
    intrinsics="V 3 3 : float",
    distortion="V D : float",
    size=checked_image_size,
    near=_checked_near,
    far=_checked_far,
    gradient=False,
)
def frustum_mask(
    points: Tensor,  # (N, 3) float32 or float64 metres, those of cloud v in the frame of camera v
    ptr: Tensor | None = None,  # (V+1,)
    *,
    intrinsics: Tensor,  # (V, 3, 3), pixels
    distortion: Tensor | None = None,  # (V, D) lenses, see pcdata.geometry.lens_models
    size: tuple[int, int],
    near: float = 0.0,
    far: float = math.inf,
    backend: str = "auto",
) -> Tensor:  # (N,) bool
    """Mark the points that lie before a camera and inside its image, hidden by others or not.

    Args:
        points: the clouds.
        ptr: row pointers.
        intrinsics: of the cameras.
        distortion: their lenses.
        size: (height, width) of the images, which span -0.5 .. width - 0.5, the left and upper edges included.
        near: metres along z; nearer points are not seen, nor is what has no depth.
        far: metres along z, likewise, itself included.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        CaptureError: impossible intrinsics or distortion.
        ConfigError: near or far are no range.
    """
    assert ptr is not None  # @op fills it
    pixels, depth = projected(points, ptr, intrinsics, distortion)
    u, v = pixels.unbind(-1)  # NaN where there is no pixel, which is inside of nothing
    inside = (u >= -0.5) & (u < size[1] - 0.5) & (v >= -0.5) & (v < size[0] - 0.5)
    return inside & (depth >= near) & (depth <= far)


@op(points="N 3", ptr="ptr N B", viewpoint=checked_places, radius_factor=checked_positive, gradient=False)
def hidden_point_mask(
    points: Tensor,  # (N, 3) float32
    ptr: Tensor | None = None,  # (B+1,); None = one cloud
    *,
    viewpoint: Sequence[float] | Sequence[Sequence[float]] | Tensor,
    radius_factor: float = 100.0,
    backend: str = "auto",
) -> Tensor:  # (N,) bool, True = hidden
    """Mark the points of surfaces that others hide from a viewpoint, without a mesh: the clouds' own points decide.

    Points are mirrored at a sphere around the viewpoint that holds them all; those on the convex hull of what comes out
    and the viewpoint are visible, the others hidden. Equal points are hidden together, a point at the viewpoint is
    visible. SciPy's hull, in float64 on the CPU: N log N a cloud, one cloud after another.

    Args:
        points: the clouds, in any unit of length.
        ptr: row pointers.
        viewpoint: x, y, z of the eye, (3,) or one per cloud (B, 3).
        radius_factor: the radius of the sphere, as a multiple of the distance to the cloud's farthest point, 1 or more.
            Larger ones hide less: 100 suits surfaces as densely sampled as a depth camera does.
        backend: which body to run; see :mod:`pcdata.contracts.dispatch`.

    Raises:
        ConfigError: a viewpoint that is not finite, or a factor below 1.

    Source: Katz, Tal and Basri, Direct visibility of point sets, SIGGRAPH 2007.
    """
    assert ptr is not None  # @op fills it
    assert isinstance(viewpoint, Tensor)  # and makes it (B, 3)
    if radius_factor < 1:
        raise ConfigError(f"hidden_point_mask: radius_factor must be 1 or more, got {radius_factor}")
    group, number = numbered_rows(points, ptr)  # equal points of a cloud
    bounds, eyes = bounds_of(ptr), viewpoint.double().cpu().numpy()
    rows, groups = points.detach().double().cpu().numpy(), group.cpu().numpy()
    visible = np.zeros(number, dtype=np.bool_)
    for eye, start, stop in zip(eyes, bounds[:-1], bounds[1:], strict=True):
        visible[groups[start:stop][_seen(rows[start:stop] - eye, radius_factor)]] = True
    return torch.from_numpy(~visible[groups]).to(points.device)


def _seen(rays: NDArray[np.float64], radius_factor: float) -> NDArray[np.int64]:
    """Return rows of one cloud, (n, 3) from the eye, that are visible; of equal ones, one at least."""
    distance = np.sqrt((rays * rays).sum(1))
    away, near = np.flatnonzero(distance > 0), np.flatnonzero(distance == 0)
    if not len(away):
        return near
    length = distance[away, None]
    flipped = rays[away] * (2 * radius_factor * length.max() / length - 1)
    corners, _ = hull_surface(np.concatenate([flipped, np.zeros((1, 3))]))
    return np.concatenate([near, away[corners[corners < len(away)]]])
