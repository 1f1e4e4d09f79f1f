"""Color beside geometry at the contacts of touching objects."""

from __future__ import annotations

import pytest
import torch

from pcdata.errors import ConfigError, DTypeError
from pcdata.functional.touching.colors import with_colors
from pcdata.functional.touching.contacts import Contacts
from pcdata.transforms import ClusterObjects
from tests.transforms.test_touching_objects import LOW_AND_HIGH, STEP_FIELDS, scene

RED, GREEN, DARK_RED = (0.8, 0.2, 0.2), (0.2, 0.7, 0.3), (0.4, 0.1, 0.1)


def strengths(left: tuple[float, ...], right: tuple[float, ...], strength: float = 0.4, wide: int = 8) -> list[float]:
    """Strengths along the border of two halves of an image of 6 rows, of two colors."""
    label = torch.zeros(6, 2 * wide, dtype=torch.int64)
    label[:, wide:] = 1
    colors = torch.where(label.flatten()[:, None] == 0, torch.tensor(left), torch.tensor(right))
    first = torch.arange(6) * 2 * wide + wide - 1
    given = Contacts(first, first + 1, torch.full((6,), strength, dtype=torch.float64))
    return with_colors(given, label, colors).strength.tolist()


def test_other_colors_strengthen_a_contact_and_one_color_weakens_it():
    assert strengths(RED, GREEN) == pytest.approx([0.6] * 6)
    assert strengths(RED, RED) == pytest.approx([0.2] * 6)
    assert max(strengths(RED, DARK_RED)) < 0.35  # in the shade, or a face that leans away
    assert strengths(RED, GREEN, strength=0.9) == [1.0] * 6


def test_color_says_nothing_where_geometry_does_not_or_no_color_is_known():
    assert strengths(RED, GREEN, strength=0.0) == [0.0] * 6
    assert strengths(RED, GREEN, wide=2) == [0.4] * 6  # regions too narrow to look aside
    nothing = Contacts(torch.zeros(0).long(), torch.zeros(0).long(), torch.zeros(0).double())
    assert with_colors(nothing, torch.zeros(2, 2).long(), torch.zeros(4, 3)) is nothing


def test_borders_that_run_across_are_looked_at_along_columns():
    label = torch.zeros(16, 6, dtype=torch.int64)
    label[8:] = 1
    first = 7 * 6 + torch.arange(6)
    given = Contacts(first, first + 6, torch.full((6,), 0.4, dtype=torch.float64))
    colors = torch.where(label.flatten()[:, None] == 0, torch.tensor(RED), torch.tensor(GREEN))
    assert with_colors(given, label, colors).strength.tolist() == pytest.approx([0.6] * 6)


def test_objects_of_other_colors_are_cut_with_more_strength():
    cloud, truth = scene(*LOW_AND_HIGH)
    found = {}
    for name, colors in (("same", (RED, RED)), ("other", (RED, GREEN))):
        painted = cloud.with_fields(colors=torch.tensor(colors)[truth.clamp(0)])
        step = ClusterObjects(**STEP_FIELDS, use_color=True)
        found[name] = step(painted).meta[0]["touching"]["cuts"]
    plain = ClusterObjects(**STEP_FIELDS)(cloud).meta[0]["touching"]["cuts"]
    (other,), (geometry,) = found["other"], plain
    assert other["strength"] >= geometry["strength"]
    assert found["same"] == []  # of one color and with a contact this shallow they are taken for one


def test_colors_are_asked_for():
    cloud, _ = scene(*LOW_AND_HIGH)
    with pytest.raises(DTypeError, match="use_color is on but the cloud has no colors"):
        ClusterObjects(**STEP_FIELDS, use_color=True)(cloud)
    with pytest.raises(ConfigError, match="say split_touching: true"):
        ClusterObjects(use_color=True)
