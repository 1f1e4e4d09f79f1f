"""Square roots that are the same on every device."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

_SPLIT = 2.0**27 + 1  # halves of 26 bits, whose products are exact


def square_root(values: Tensor) -> Tensor:
    """Return square roots of float64, correctly rounded, below 1e300; torch's own may be one unit off.

    NumPy's are on the CPU. Elsewhere torch's root is moved by a unit where the exact error of its square says so.

    Source: Dekker, A floating-point technique for extending the available precision, Numerische Mathematik 18, 1971.
    """
    if values.device.type == "cpu":
        with np.errstate(invalid="ignore"):
            return torch.from_numpy(np.sqrt(values.detach().numpy()))
    root = values.detach().sqrt()
    above = torch.nextafter(root, torch.full_like(root, torch.inf))
    below = torch.nextafter(root, torch.zeros_like(root))
    square = root * root
    large = root * _SPLIT
    high = large - (large - root)
    low = root - high
    error = ((high * high - square) + 2 * (high * low)) + low * low
    left = (values.detach() - square) - error  # of the value, when the square of the root is taken from it, exactly
    # The borders are the squares of the numbers halfway to the next roots; no value lies on one.
    nearest = torch.where(left > root * (above - root), above, root)
    nearest = torch.where(left <= -root * (root - below), below, nearest)
    return torch.where((root > 0) & root.isfinite(), nearest, root)
