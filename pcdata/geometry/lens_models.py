"""The lens models by name, and how a lens of any of them is one row of numbers.

A lens of OpenCV's polynomial is its coefficients as they are: 4, 5, 8, 12 or 14 of them. A lens of any other model is
a row of 16: the number of its model, then its coefficients, then zeros. A polynomial can be such a row too (model 0),
so that views of one rig with different lenses stand in one tensor.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from pcdata.errors import CaptureError, near_matches

POLYNOMIAL_COUNTS = (4, 5, 8, 12, 14)
ROW = 16  # numbers of a lens whose model is not OpenCV's polynomial
WIDEST_PLAIN = 12  # coefficients of a polynomial without tilt: what compiled bodies know

# By name: the number of the model in a row, and how many coefficients it has.
LENS_MODELS: dict[str, tuple[int, tuple[int, ...]]] = {
    "opencv": (0, POLYNOMIAL_COUNTS),
    "inverse_brown_conrady": (1, (5,)),
    "fisheye": (2, (4,)),
    "f_theta": (3, (1,)),
    "f_theta_polynomial": (4, (4,)),
    "inverse_f_theta_polynomial": (5, (4,)),
}
# Lenses that look the same in all directions around the axis; the last three bend with zeros for coefficients too.
RADIAL = ("f_theta", "fisheye", "f_theta_polynomial", "inverse_f_theta_polynomial")
_NAMES = {number: name for name, (number, _) in LENS_MODELS.items()}
# What others call them. RealSense's SDK computes its inverse and its modified model alike, in both directions.
_OTHER_NAMES = {
    "plumb_bob": "opencv",
    "rational_polynomial": "opencv",
    "brown_conrady": "opencv",
    "modified_brown_conrady": "inverse_brown_conrady",
    "equidistant": "fisheye",
    "kannala_brandt": "fisheye",
    "kannala_brandt4": "fisheye",
    "opencv_fisheye": "fisheye",
    "ftheta": "f_theta",
}


def model_named(name: str) -> str | None:
    """Return our name of a lens model that ROS, OpenCV or RealSense calls so; None where none is known."""
    plain = name.strip().lower().replace(" ", "_").replace("-", "_")
    return plain if plain in LENS_MODELS else _OTHER_NAMES.get(plain)


def lens_row(where: str, model: str, coefficients: Sequence[float]) -> list[float]:
    """Return the row of a lens; OpenCV's polynomials stay as they are.

    Zeros after the coefficients are left out: RealSense's SDK always writes five.

    Raises:
        CaptureError: the model is not known, or has another number of coefficients.
    """
    known = model_named(model)
    if known is None:
        names = (*LENS_MODELS, *_OTHER_NAMES)
        raise CaptureError(
            f"{where}: the lens model {model!r:.60} is not known{near_matches(model, names)}; known: "
            f"{', '.join(LENS_MODELS)}"
        )
    number, counts = LENS_MODELS[known]
    values = [float(value) for value in coefficients]
    if len(values) not in counts and known != "opencv" and not any(values[counts[-1] :]):
        values = values[: counts[-1]]
    if len(values) not in counts:
        raise CaptureError(
            f"{where}: a lens of the model {known} has {' or '.join(map(str, counts))} coefficients, got {len(values)}"
        )
    return values if known == "opencv" else [float(number), *values, *[0.0] * (ROW - 1 - len(values))]


def lens_facts(row: Sequence[float] | Tensor) -> tuple[str, list[float]]:
    """Return the model of a lens and its coefficients, the other way of :func:`lens_row`."""
    values = [float(value) for value in (row.tolist() if isinstance(row, Tensor) else row)]
    if len(values) != ROW:
        return "opencv", values
    name = _NAMES[int(values[0])]
    return name, values[1 : 1 + LENS_MODELS[name][1][-1]]


def is_plain(distortion: Tensor | None) -> bool:
    """Say whether all lenses (V, D) are polynomials without tilt, or there are none."""
    return distortion is None or distortion.shape[-1] <= WIDEST_PLAIN


def same_width(lenses: Iterable[Tensor | None], views: Iterable[int]) -> Tensor | None:  # (V, D)
    """Return the lenses (V_i, D_i) of some cameras as one tensor; None where no camera has one.

    Polynomials with fewer coefficients than others get zeros for the rest, which bend nothing.
    """
    given = [(lens, count) for lens, count in zip(lenses, views, strict=True)]
    widest = max((lens.shape[1] for lens, _ in given if lens is not None), default=0)
    if not widest:
        return None
    rows = []
    for lens, count in given:
        if lens is None:
            lens = torch.zeros(count, 1, dtype=torch.float64, device="cpu")
        if widest == ROW and lens.shape[1] != ROW:
            lens = torch.nn.functional.pad(lens, (1, 0))  # the number of the polynomials is 0
        rows.append(torch.nn.functional.pad(lens, (0, widest - lens.shape[1])))
    return torch.cat(rows)


def turned_lenses(where: str, distortion: Tensor) -> Tensor:
    """Return (V, D) lenses seen from axes turned by a quarter: x along the old y, y against the old x.

    Radial terms stay; decentering (p1, p2) and thin prism terms (s1..s4) turn with the axes.

    Raises:
        CaptureError: a tilted sensor, whose tilts are of the old axes.
    """
    turned = distortion.clone()
    begin = int(distortion.shape[1] == ROW)
    radial = {LENS_MODELS[name][0] for name in RADIAL}
    bends = [view for view in range(len(turned)) if not begin or int(distortion[view, 0]) not in radial]
    given = distortion[bends, begin:]
    if bool((given[:, WIDEST_PLAIN:] != 0).any()):
        raise CaptureError(f"{where}: a tilted sensor (tau_x, tau_y) cannot be turned; undistort the image first")
    if bends:
        turned[bends, begin + 2], turned[bends, begin + 3] = -given[:, 3], given[:, 2]
        if given.shape[1] >= WIDEST_PLAIN:
            turned[bends, begin + 8 : begin + 12] = torch.cat([given[:, 10:12], -given[:, 8:10]], dim=1)
    return turned


def check_distortion(where: str, distortion: Tensor) -> None:
    """Require (..., D) lenses: D is 4, 5, 8, 12 or 14, or 16 for rows that name their model.

    Raises:
        CaptureError: any other number, or a row of no known model.
    """
    count = distortion.shape[-1] if distortion.ndim else 0
    if count == ROW:
        for number in distortion[..., 0].flatten().tolist():
            if number not in _NAMES:
                raise CaptureError(
                    f"{where}: a lens of {ROW} numbers begins with that of its model ({_listed()}), got {number:g}; "
                    "Camera.pinhole(lens=...) makes such rows"
                )
    elif count not in POLYNOMIAL_COUNTS:
        raise CaptureError(
            f"{where}: distortion must hold 4, 5, 8, 12 or 14 coefficients per view in OpenCV's order "
            f"(k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y), or a row of {ROW} that names another model, got "
            f"{count}; pass None for a lens without distortion"
        )


def _listed() -> str:
    return ", ".join(f"{number} {name}" for number, name in _NAMES.items())
