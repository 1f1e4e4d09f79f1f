"""What is compared: every number's family, unit and limits, with the reason for them."""

from __future__ import annotations

from dataclasses import dataclass

from pcdata.validation.comparison.distances import in_words
from pcdata.verdicts import in_figures


@dataclass(frozen=True)
class Quantity:
    """A number of every capture.

    Args:
        name: of the number.
        family: what is named when it differs.
        title: in words.
        limits: the largest difference that passes, and the largest that does not fail; None = told only.
        unit: as shown.
        shown: times the number, as shown.
        is_relative: whether limits are shares of the larger value.
        floor: difference that passes whatever its share is.
    """

    name: str
    family: str
    title: str
    limits: tuple[float, float] | None
    unit: str = ""
    shown: float = 1.0
    is_relative: bool = False
    floor: float = 0.0

    def allowed(self, a: float, b: float) -> tuple[float, float] | None:
        """Return both limits as differences of two values."""
        if self.limits is None:
            return None
        scale = max(abs(a), abs(b)) if self.is_relative else 1.0
        return max(self.floor, self.limits[0] * scale), max(self.floor, self.limits[1] * scale)

    def text(self, value: float) -> str:
        """Return a value with its unit."""
        return f"{in_figures(value * self.shown)} {self.unit}".rstrip()


def _rows() -> tuple[Quantity, ...]:
    length, share, angle = (0.003, 0.01), (0.005, 0.03), (0.5, 2.0)  # metres; of an image; degrees
    metre, mm = {"unit": "m", "is_relative": True}, {"unit": "mm", "shown": 1e3}
    per_cent, degrees = {"unit": "%", "shown": 100.0}, {"unit": "degrees"}
    told: dict[str, dict[str, object]] = {}

    def add(family: str, name: str, title: str, limits: tuple[float, float] | None, **how: object) -> None:
        told[name] = {"family": family, "name": name, "title": title, "limits": limits, **how}

    # Depth: models are trained on the reach; a tenth is less than scenes of one table differ by.
    for name, title in (("near", "nearest 2 %"), ("median", "median distance"), ("far", "farthest 2 %")):
        add("distances", name, title, (0.1, 0.3), **metre)
    for name, title in (("nearest", "nearest reading"), ("farthest", "farthest reading")):
        add("distances", name, title, None, unit="m")
    add("distances", "share", "readings", None, **per_cent)
    # Lens: 0.5 % of the field of view moves a point at the rim by as much.
    for axis, side in (("x", "width"), ("y", "height")):
        add("lens", f"fov_{axis}", f"field of view over the {side}", (0.005, 0.03), unit="degrees", is_relative=True)
        add("lens", f"center_{axis}", f"principal point over the {side}", (0.005, 0.03), **per_cent)
    # Density decides what radii and voxels hold.
    add("density", "density", "points on a square metre", (0.15, 0.5), unit="/m2", is_relative=True)
    add("density", "points", "points", (0.15, 0.5), is_relative=True)
    # Noise: what filters are set by; 0.1 mm is the rounding of most sensors.
    add("noise", "noise", "noise on flat parts", (0.2, 0.5), **mm, is_relative=True, floor=1e-4)
    add("flying pixels", "flying", "flying pixels", (0.0005, 0.005), **per_cent)
    add("holes", "holes", "without a reading", share, **per_cent)
    add("holes", "holes_edges", "holes at edges of depth", (0.003, 0.02), **per_cent)
    add("holes", "holes_inside", "holes inside surfaces", (0.003, 0.02), **per_cent)
    add("holes", "holes_border", "bands at the border of the image", share, **per_cent)
    add("holes", "hole_width", "width of holes", None, unit="pixels")
    # Table: 3 mm is what heights of grasps bear.
    add("table", "table_height", "height of the table", length, **mm)
    add("table", "table_tilt", "tilt of the table", angle, **degrees)
    add("camera", "camera_height", "camera over the table", length, **mm)
    add("camera", "camera_tilt", "camera's axis from straight down on the table", angle, **degrees)
    for axis in "xyz":
        add("camera", f"camera_{axis}", f"camera's {axis}", length, **mm)
        add("camera", f"turned_{axis}", f"camera turned about its {axis}", (0.3, 1.0), **degrees)
        add("extent", f"lower_{axis}", f"begin along {axis}", (0.02, 0.05), **mm)
        add("extent", f"upper_{axis}", f"end along {axis}", (0.02, 0.05), **mm)
        add("extent", f"min_{axis}", f"least {axis}", None, unit="m")
        add("extent", f"max_{axis}", f"largest {axis}", None, unit="m")
    # Objects: half an object more or less; a quarter of a size.
    add("objects", "objects", "objects on the table", (0.75, 2.0))
    for name, title in (("object_height", "height of objects"), ("object_size", "size of objects")):
        add("objects", name, title, (0.15, 0.4), **mm, is_relative=True, floor=0.005)
    # Colors: below a twentieth of the range color jitter covers it.
    for name in ("brightness", "contrast", "saturation"):
        add("colors", name, name, (0.05, 0.15), **per_cent)
    add("colors", "warmth", "red less blue", (0.05, 0.15), **per_cent)
    add("colors", "greenness", "green less red and blue", (0.05, 0.15), **per_cent)
    return tuple(Quantity(**one) for one in told.values())  # type: ignore[arg-type]


QUANTITIES = {one.name: one for one in _rows()}


def quantity_of(name: str) -> Quantity:
    """Return the row of a number; ``name@3`` is the number within a class of distances."""
    base, _, _ = name.partition("@")
    return QUANTITIES[base]


def title_of(name: str) -> str:
    """Return what a number is, in words."""
    base, _, number = name.partition("@")
    return QUANTITIES[base].title + (f", {in_words(int(number))}" if number else "")
