"""Numbers without a unit are metres only where they look like it; whoever states a unit is believed."""

from __future__ import annotations

import re

import numpy as np
import pytest

from pcdata.contracts.lengths import check_metres, plausible_units, width_of_points
from pcdata.errors import UnitError

# Longest sides in metres of things that cameras and robots see.
OBJECTS = {"nut": 0.025, "cup": 0.08, "box": 0.15, "bottle": 0.25, "tray": 0.6, "table": 1.8}
SCENES = {"room": 7.0, "lecture room": 16.0, "hall": 60.0, "street": 180.0}


def box(length: float, n: int = 4000) -> np.ndarray:
    """Points on the surface of a box, one side ``length``."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (n, 3))
    points[np.arange(n), rng.integers(0, 3, n)] = np.where(rng.random(n) < 0.5, -0.5, 0.5)
    return points * length * np.array([1.0, 0.6, 0.4])


@pytest.mark.parametrize("name", OBJECTS)
@pytest.mark.parametrize("unit", [0.001, 0.0001])
def test_objects_in_small_units_are_refused_and_following_the_advice_gives_their_size(name: str, unit: float) -> None:
    points = box(OBJECTS[name]) / unit
    with pytest.raises(UnitError, match="in a unit that nobody states") as caught:
        check_metres("here", points, None)
    advised = [float(found) for found in re.findall(r"metres_per_unit=([0-9.]+)", str(caught.value))]
    if unit == 0.001:
        assert unit in advised
    for one in advised:
        assert check_metres("here", points, one) == one


@pytest.mark.parametrize("name", [*OBJECTS, *SCENES])
def test_what_is_stated_is_believed_and_metres_of_rooms_need_no_word(name: str) -> None:
    length = (OBJECTS | SCENES)[name]
    for unit in (1.0, 0.01, 0.001):
        assert check_metres("here", box(length) / unit, unit) == unit
    if length <= 20:
        assert check_metres("here", box(length), None) == 1.0
    else:
        with pytest.raises(UnitError, match=r"metres_per_unit=1 if these are metres"):
            check_metres("here", box(length), None)


def test_a_few_flying_pixels_do_not_make_a_table_a_hall() -> None:
    points = box(1.8)
    points[:60, 2] = 65.535
    assert check_metres("here", points, None) == 1.0


def test_a_small_patch_far_from_its_sensor_is_not_in_metres() -> None:
    patch = box(9.0) + np.array([0, 0, 640.0])  # 9 mm of a part 640 mm from the camera
    with pytest.raises(UnitError, match="half of the points are 640"):
        check_metres("here", patch, None)
    assert check_metres("here", patch, None, viewpoint=(0, 0, 638.0)) == 1.0
    assert check_metres("here", patch, 1.0) == 1.0


def test_a_unit_that_was_applied_before_is_noticed() -> None:
    with pytest.raises(UnitError, match=r"looks like metres already; pass metres_per_unit=1.0"):
        check_metres("here", box(0.15), 0.001)
    assert check_metres("here", box(0.15)[:3], 0.001) == 0.001  # too few to tell


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((1, 3)), np.ones((500, 3))])
def test_no_points_and_one_place_have_no_width(points: np.ndarray) -> None:
    assert width_of_points(points) == 0
    assert check_metres("here", points, None) == 1.0
    assert check_metres("here", points, 0.001) == 0.001


@pytest.mark.parametrize("unit", [0, -1, 1000, float("nan"), True, "mm"])
def test_factors_that_cannot_be_are_refused(unit: object) -> None:
    with pytest.raises(UnitError, match="above 0 and at most 1"):
        check_metres("here", box(1.0), unit)  # type: ignore[arg-type]


def test_several_units_may_fit_one_length() -> None:
    assert plausible_units(80.0) == {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "metres": 1.0}
    assert plausible_units(4000.0) == {"millimetres": 0.001, "centimetres": 0.01}
