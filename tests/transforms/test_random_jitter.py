from __future__ import annotations

import pytest
import torch
from kornia.enhance import (
    adjust_brightness_accumulative,
    adjust_contrast_with_mean_subtraction,
    adjust_hue,
    adjust_saturation,
)

from pcdata.errors import ConfigError, DTypeError
from pcdata.functional.noise import normal_rows, random_rows
from pcdata.rng import Streams, seeded
from pcdata.structures import PointCloud
from pcdata.transforms import RandomColorJitter, RandomJitter, RandomPointDropout
from tests.factories import cloud_in_base


def big_cloud(count: int = 20_000) -> PointCloud:
    generator = seeded(5)
    return PointCloud(points=torch.zeros(count, 3), colors=torch.rand(count, 3, generator=generator), frame_id="base")


def test_jitter_is_gaussian_with_the_given_spread():
    noise = RandomJitter(sigma=0.01, clip=None)(big_cloud(), generator=seeded(0)).points
    # 60,000 values: the standard deviation of their mean is 4e-5, of their spread 3e-5.
    assert abs(float(noise.mean())) < 2e-4
    assert float(noise.std()) == pytest.approx(0.01, abs=1.5e-4)
    within = float((noise.abs() < 0.01).double().mean())
    assert within == pytest.approx(0.6827, abs=0.01)
    assert float(torch.corrcoef(noise.T).fill_diagonal_(0).abs().max()) < 0.03


def test_jitter_is_clipped_and_moves_nothing_else():
    cloud = cloud_in_base()
    moved = RandomJitter(sigma=0.01, clip=0.012)(cloud, generator=seeded(0))
    change = (moved.points - cloud.points).abs()
    assert float(change.max()) <= 0.012 + 1e-7
    assert float((change > 0.0119).double().mean()) > 0.1
    assert torch.equal(moved.normals, cloud.normals)
    assert torch.equal(RandomJitter(sigma=0.0)(cloud, generator=seeded(0)).points, cloud.points)


def test_jitter_of_one_seed_is_drawn_again_from_the_history():
    cloud = cloud_in_base((50,))
    step = RandomJitter()
    moved = step(cloud, generator=seeded(3))
    seed = moved.history[0][-1]["params"]["seed"]
    again = step.transform(cloud, {"seed": torch.tensor([seed])})
    assert torch.equal(again.points, moved.points)


def test_dropout_removes_the_drawn_fraction_and_keeps_the_order():
    cloud = cloud_in_base((400, 200))
    fractions = []
    for seed in range(40):
        kept = RandomPointDropout(low=0.2, high=0.6)(cloud, generator=seeded(seed))
        for before, after in zip(cloud.unbatch(), kept.unbatch()):
            rows = after.extra["row"].tolist()
            assert rows == sorted(set(rows))
            fractions.append(1 - after.num_points / before.num_points)
    assert min(fractions) >= 0.195
    assert max(fractions) <= 0.605
    assert min(fractions) < 0.23
    assert max(fractions) > 0.57


@pytest.mark.parametrize("clip", [None, 0.01])
def test_the_noise_of_a_cloud_is_the_standard_normal_of_its_seed(clip):
    cloud = cloud_in_base((17, 0, 400, 3))
    step = RandomJitter(sigma=0.02, clip=clip)
    seeds = step.make_params(cloud, Streams.of(seeded(4), 4))["seed"]
    parts = [normal_rows(torch.tensor([0, count]), seed[None]) for count, seed in zip((17, 0, 400, 3), seeds)]
    noise = torch.cat(parts)
    noise = noise * 0.02 if clip is None else (noise * 0.02).clamp(-clip, clip)
    assert torch.equal(step(cloud, generator=seeded(4)).points, cloud.points + noise)


def test_dropout_keeps_the_rows_that_its_seed_chooses():
    cloud = cloud_in_base((50, 0, 300))
    step = RandomPointDropout(low=0.3, high=0.5)
    streams = Streams.of(seeded(4), 3)
    fractions, seeds = streams.uniform(0.3, 0.5).tolist(), streams.seeds()
    rows = []
    for start, count, fraction, seed in zip((0, 50, 50), (50, 0, 300), fractions, seeds):
        kept = torch.tensor([count - round(count * fraction)])
        rows.append(start + random_rows(torch.tensor([count]), kept, seed[None]).nonzero().squeeze(1))
    assert torch.equal(step(cloud, generator=seeded(4)).extra["row"], torch.cat(rows))


def test_dropout_leaves_at_least_one_point():
    step = RandomPointDropout(low=1.0, high=1.0)
    assert step(cloud_in_base((50, 1, 0)), generator=seeded(0)).counts.tolist() == [1, 1, 0]
    with pytest.raises(ConfigError, match=r"low 0\.5 exceeds high 0\.1"):
        RandomPointDropout(low=0.5)


def test_dropout_hits_every_row_alike():
    cloud = cloud_in_base((20,))
    step = RandomPointDropout(low=0.5, high=0.5)
    rows = torch.cat([step(cloud, generator=seeded(seed)).extra["row"] for seed in range(200)])
    counts = torch.bincount(rows, minlength=20)
    assert 65 < int(counts.min()) <= int(counts.max()) < 135  # 100 expected, standard deviation 7


def test_colors_are_changed_as_kornia_changes_an_image():
    cloud = cloud_in_base((50, 80))
    step = RandomColorJitter(brightness=0.4, contrast=0.4, saturation=0.4, hue=0.1)
    factors = step.make_params(cloud, Streams.of(seeded(2), 2))["factors"]
    result = step(cloud, generator=seeded(2))
    for single, after, (brightness, contrast, saturation, hue) in zip(cloud.unbatch(), result.unbatch(), factors):
        image = single.colors.T.reshape(1, 3, 1, -1)
        image = adjust_brightness_accumulative(image, brightness.float())
        image = adjust_contrast_with_mean_subtraction(image, contrast.float())
        image = adjust_saturation(image, saturation.float())
        image = adjust_hue(image, hue.float() * 2 * torch.pi)
        torch.testing.assert_close(after.colors, image.reshape(3, -1).T.clamp(0, 1), atol=1e-6, rtol=0)
        assert 0.6 <= float(brightness) < 1.4
        assert abs(float(hue)) <= 0.1


def test_colors_stay_colors_at_the_extremes():
    step = RandomColorJitter(brightness=1.0, contrast=1.0, saturation=1.0, hue=0.5)
    cloud = cloud_in_base((200,))
    for seed in range(20):
        colors = step(cloud, generator=seeded(seed)).colors
        assert bool(torch.isfinite(colors).all())
        assert float(colors.min()) >= 0.0
        assert float(colors.max()) <= 1.0


def test_no_change_is_no_change():
    cloud = cloud_in_base((50,))
    still = RandomColorJitter(brightness=0, contrast=0, saturation=0, hue=0)(cloud, generator=seeded(0))
    torch.testing.assert_close(still.colors, cloud.colors, atol=1e-5, rtol=0)


def test_a_cloud_without_colors_and_a_hue_beyond_half_a_turn_are_refused():
    with pytest.raises(DTypeError, match="has no colors"):
        RandomColorJitter()(cloud_in_base().with_fields(colors=None), generator=seeded(0))
    with pytest.raises(ConfigError, match=r"hue is in turns, at most 0\.5, got 0\.6"):
        RandomColorJitter(hue=0.6)
