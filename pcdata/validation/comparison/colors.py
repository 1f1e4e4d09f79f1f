"""What colors have in common over an image or a cloud."""

from __future__ import annotations

from torch import Tensor

_MOST = 40_000  # pixels or points that are looked at


def measure_colors(colors: Tensor) -> dict[str, float]:
    """Return the numbers of (N, 3) RGB, uint8 or floats in 0..1; all are shares of the whole range."""
    some = colors[:: max(1, len(colors) // _MOST)]
    rgb = some.double() / (1.0 if some.is_floating_point() else 255.0)
    if not len(rgb):
        return {}
    red, green, blue = rgb.mean(0).tolist()
    luma = rgb @ rgb.new_tensor([0.299, 0.587, 0.114])  # ITU-R BT.601
    return {
        "brightness": float(luma.mean()),
        "contrast": float(luma.std(unbiased=False)),
        "saturation": float((rgb.amax(1) - rgb.amin(1)).mean()),
        "warmth": red - blue,
        "greenness": green - (red + blue) / 2,
    }
