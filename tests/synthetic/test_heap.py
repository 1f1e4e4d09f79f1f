"""Objects that are pushed together touch and do not overlap."""

from __future__ import annotations

import pytest
import torch

from pcdata.errors import ConfigError
from pcdata.synthetic import tabletop
from pcdata.synthetic.heap import _surface, heap_objects
from pcdata.synthetic.shapes import Shape


def _surface_of(shape: Shape) -> torch.Tensor:
    """Points all over a shape where it stands."""
    origin = torch.eye(4, dtype=torch.float64)
    origin[:3, :3] = shape.base_from_object[:3, :3]
    return _surface(type(shape)(**{**vars(shape), "base_from_object": origin})) + shape.center


@pytest.mark.parametrize("seed", [0, 1])
def test_every_object_touches_another_and_none_overlaps(seed: int) -> None:
    objects = heap_objects(seed, 20)
    surfaces = [_surface_of(shape) for shape in objects]
    for one, shape in enumerate(objects):
        apart = [float(other.signed_distance(surfaces[one]).min()) for other in objects if other is not shape]
        apart += [float(shape.signed_distance(rows).min()) for k, rows in enumerate(surfaces) if k != one]
        assert -0.002 < min(apart) < 0.002  # surfaces are sampled
        assert float(surfaces[one][:, 2].min()) > -1e-6


def test_more_objects_leave_the_first_ones_where_they_are() -> None:
    few, many = heap_objects(3, 5), heap_objects(3, 9)
    assert [type(shape) for shape in few] == [type(shape) for shape in many[:5]]
    assert all(torch.equal(one.base_from_object, other.base_from_object) for one, other in zip(few, many))


def test_a_scene_of_touching_objects_says_so_and_has_a_limit() -> None:
    scene = tabletop(0, 4, size=(24, 32), touching=True)
    assert scene.frame.provenance["touching"] is True
    assert [shape.label for shape in scene.truth.objects] == [1, 2, 3, 4]
    with pytest.raises(ConfigError, match="touching objects fit on the table; ask for fewer"):
        heap_objects(0, 200)
