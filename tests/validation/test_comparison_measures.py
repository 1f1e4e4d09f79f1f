"""What sources are compared by, against scenes whose truth is known; and the statistics against SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pcdata.synthetic import tabletop
from pcdata.transforms import Deproject, ToFrame
from pcdata.validation.comparison.clouds import measure_points
from pcdata.validation.comparison.colors import measure_colors
from pcdata.validation.comparison.depth_images import measure_depth, noise_of_tiles
from pcdata.validation.comparison.description import describe
from pcdata.validation.comparison.distances import class_of, middle_of
from pcdata.validation.comparison.statistics import compared, significant, worth_of

FOCAL = 150.0


def plane(noise: float = 0.0, slope: float = 0.3) -> np.ndarray:
    """A tilted plane at about 0.85 m, seen by 120 x 160 pixels."""
    across = (np.arange(160) - 79.5) / FOCAL
    depth = np.tile(0.85 / (1 + slope * across), (120, 1))
    return (depth + noise * np.random.default_rng(0).normal(size=depth.shape)).astype(np.float32)


@pytest.mark.parametrize("sigma", [0.0005, 0.002, 0.01])
def test_noise_about_a_tilted_plane_is_what_was_added(sigma):
    found = noise_of_tiles(plane(sigma))
    for value in found.values():
        assert value == pytest.approx(sigma, rel=0.15)  # a quarter of the tiles has less


def test_a_plane_without_noise_has_none_however_steep():
    assert max(noise_of_tiles(plane(slope=1.0)).values()) < 1e-6


def test_holes_are_told_by_where_they_are():
    depth = plane(slope=0.0)
    depth[:, 100:] = 1.5
    depth[20:24, 20:25] = 0  # inside: 20 pixels
    depth[50:60, 98:102] = 0  # at the step: 40
    depth[:, :2] = 0  # a band: 240
    found = measure_depth(depth, FOCAL)
    pixels = {name: round(found[f"holes_{name}"] * depth.size) for name in ("inside", "edges", "border")}
    assert pixels == {"inside": 20, "edges": 40, "border": 240}
    assert found["holes"] * depth.size == pytest.approx(300)
    assert found["hole_width"] == pytest.approx(240**0.5)


def test_a_hole_in_a_steep_surface_is_inside():
    depth = plane(slope=1.2)
    depth[30:60, 60:90] = 0
    found = measure_depth(depth, FOCAL)
    assert found["holes_edges"] == 0
    assert found["holes_inside"] > 0


def test_flying_pixels_are_those_between_surfaces():
    depth = plane(0.001, slope=0.0)
    depth[10:110:10, 10:150:10] = 1.2
    assert measure_depth(depth, FOCAL)["flying"] == pytest.approx(140 / depth.size, rel=1e-3)
    assert measure_depth(plane(0.01), FOCAL)["flying"] == 0  # noise alone


def test_an_image_without_readings_has_holes_alone():
    assert measure_depth(np.zeros((20, 30), np.float32), FOCAL) == {"holes": 1.0}


def test_classes_of_distances_hold_their_middles():
    assert class_of(np.array([middle_of(k) for k in range(18)])).tolist() == [*range(18)]
    assert class_of(np.array([0.0, 1e9])).tolist() == [0, 17]


@pytest.mark.parametrize("seed", range(4))
def test_table_and_objects_are_the_scenes(seed):
    scene = tabletop(seed, num_objects=4, size=(240, 320))
    told = describe(scene.frame)
    assert float(told.tables[0].plane[3]) == pytest.approx(0.0, abs=1e-4)
    assert abs(float(told.tables[0].plane[2])) == pytest.approx(1.0, abs=1e-6)
    assert scene.frame.world_from_camera is not None
    assert told.numbers["camera_height", 0] == pytest.approx(float(scene.frame.world_from_camera[0, 2, 3]), abs=1e-3)
    seen = set(scene.frame.labels[scene.frame.labels > 0].tolist())  # type: ignore[index]
    assert abs(told.numbers["objects", 0] - len(seen)) <= 1  # one may hide behind another, or touch it in the image
    cloud = describe(ToFrame(frame="base")(Deproject()(scene.frame)))
    assert cloud.numbers["objects", None] == told.numbers["objects", 0]


def test_density_and_noise_of_points_are_those_they_were_drawn_with():
    draw = torch.Generator().manual_seed(0)
    flat = torch.rand(20_000, 3, generator=draw) * torch.tensor([1.0, 1.0, 0.0])
    points = flat + torch.randn(20_000, 3, generator=draw) * torch.tensor([0.0, 0.0, 0.002])
    found = measure_points(points, torch.tensor([0.5, 0.5, 0.8]))
    density = [value for name, value in found.items() if name.startswith("density@")]
    noise = [value for name, value in found.items() if name.startswith("noise@")]
    assert density[0] == pytest.approx(20_000, rel=0.15)
    assert noise[0] == pytest.approx(0.002, rel=0.15)
    assert found["upper_x"] - found["lower_x"] == pytest.approx(0.98, abs=0.02)


def test_colors_are_measured_alike_as_bytes_and_as_numbers():
    colors = torch.randint(0, 256, (500, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    assert measure_colors(colors) == pytest.approx(measure_colors(colors.float() / 255), abs=1e-6)
    assert measure_colors(torch.tensor([[255, 0, 0]], dtype=torch.uint8))["warmth"] == 1.0


def test_the_test_of_trimmed_means_is_yuens():
    from scipy.stats import ttest_ind

    draw = np.random.default_rng(1)
    for count_a, count_b in ((5, 7), (6, 5), (7, 7)):  # too few to tell whether captures in a row are alike
        a, b = draw.normal(size=count_a), draw.exponential(size=count_b) + 1
        ours, theirs = compared(a, b), ttest_ind(b, a, equal_var=False, trim=0.2)
        assert ours.p == pytest.approx(theirs.pvalue, rel=0.05)
        assert (ours.b - ours.a) / ours.error == pytest.approx(theirs.statistic, rel=0.02)


def test_captures_that_are_alike_are_worth_fewer():
    draw = np.random.default_rng(0)
    alone = draw.normal(size=400)
    assert worth_of(alone) > 250
    alike = np.repeat(draw.normal(size=40), 10)
    assert worth_of(alike) < 80
    assert worth_of(np.ones(50)) == 50


def test_holms_rule_is_that_of_the_paper():
    assert significant([0.01, 0.04, 0.03, 0.005], alpha=0.05) == [True, False, False, True]
    assert significant([float("nan"), 0.5, 1e-9]) == [False, False, True]
    assert significant([]) == []


def test_samples_of_one_source_differ_as_rarely_as_stated():
    draw = np.random.default_rng(3)
    chances = [compared(*draw.lognormal(size=(2, 12))).p for _ in range(600)]
    assert np.mean(np.array(chances) < 0.05) < 0.075
    assert np.mean(np.array(chances) < 0.01) < 0.02
