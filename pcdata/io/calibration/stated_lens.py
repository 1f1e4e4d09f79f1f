"""The lens that a recording or a calibration file states by the name of its model."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pcdata.errors import IntrinsicsError, PcdataError
from pcdata.geometry.lens_models import LENS_MODELS, RADIAL, lens_row, model_named


def lens_of(where: str, model: str, coefficients: Sequence[float]) -> list[float] | None:
    """Return the row of a lens, see :mod:`pcdata.geometry.lens_models`; None where nothing is bent.

    Raises:
        IntrinsicsError: the model is not known, or has another number of coefficients.
    """
    numbers = [float(value) for value in coefficients]
    if not all(map(math.isfinite, numbers)):
        raise IntrinsicsError(f"{where} has a lens with coefficients that are not finite: {numbers}")
    known = model_named(model)
    # All zeros bend nothing, but for a fisheye, which they leave equidistant.
    if not any(numbers) and (known not in RADIAL[1:] or not numbers):
        return None
    if known is None:
        raise IntrinsicsError(
            f"{where} has the lens model {model!r:.60} with {len(numbers)} coefficients {numbers}, which is not known; "
            f"known are {', '.join(LENS_MODELS)} and what ROS and RealSense call them; undistort the recording first"
        )
    try:
        return lens_row(where, known, numbers)
    except PcdataError as error:
        raise IntrinsicsError(f"{error}; undistort the recording first") from error
