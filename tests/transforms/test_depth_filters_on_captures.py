"""The depth filters on real recordings, against what librealsense documents of its own, written out in NumPy.

Source: librealsense, doc/post-processing-filters.md.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pcdata import Camera, DepthFrame, open_source
from pcdata import transforms as T
from pcdata.errors import MissingExtraError
from pcdata.functional import depth_to_disparity, fill_holes, spatial_filter, temporal_filter

BASELINE = 0.05  # metres


def recording(test_data: Path) -> list[DepthFrame]:
    """A D435 with holes: two frames."""
    try:
        source = open_source(test_data / "realsense_bag" / "single_depth_color_640x480.bag")
    except MissingExtraError as error:
        pytest.skip(str(error))
    return [source.load(name) for name in source.ids]


def stream(test_data: Path) -> list[DepthFrame]:
    """A tabletop on which something moves: four frames, nearly without holes."""
    camera = Camera.pinhole(fx=927.17, fy=927.37, cx=651.32, cy=349.62, size=(720, 1280))
    files = [test_data / "tabletop_stream" / f"depth_{number:03d}.npy" for number in range(4)]
    depths = [torch.from_numpy(np.load(file).astype(np.float32))[None] / 1000 for file in files]
    return [DepthFrame(depth=depth, camera=camera) for depth in depths]


@pytest.fixture(scope="module", params=[recording, stream], ids=["realsense_bag", "tabletop_stream"])
def frames(request, test_data) -> list[DepthFrame]:
    return request.param(test_data)


def disparities(frames: list[DepthFrame]) -> list[torch.Tensor]:
    return [depth_to_disparity(one.depth, one.camera.intrinsics[:, 0, 0], BASELINE) for one in frames]


def blocks(image: np.ndarray, factor: int) -> np.ndarray:
    """The (h, w, factor * factor) pixels of every block, NaN without a reading."""
    height, width = (side // factor for side in image.shape)
    whole = np.where(image > 0, image, np.nan)[: height * factor, : width * factor].astype(np.float64)
    return whole.reshape(height, factor, width, factor).transpose(0, 2, 1, 3).reshape(height, width, factor**2)


@pytest.mark.parametrize("factor", [2, 3])
def test_decimation_by_2_and_3_takes_the_median_of_the_readings(frames, factor):
    image = frames[0].depth[0].numpy()
    ordered = np.sort(blocks(image, factor), axis=-1)  # NaN last
    count = (~np.isnan(ordered)).sum(-1)
    middle = np.stack([(count - 1).clip(0) // 2, count // 2], axis=-1)
    lower, upper = np.moveaxis(np.take_along_axis(ordered, middle, -1), -1, 0)
    found = T.DecimateDepth(factor=factor)(frames[0])
    depth = found.depth[0].numpy()
    assert np.array_equal(depth > 0, count > 0)
    # librealsense takes the lower of the middle two; here it is their mean where both are of one surface.
    seen = count > 0
    assert (depth[seen] >= np.float32(lower[seen])).all()
    odd = seen & (count % 2 == 1)
    assert np.array_equal(depth[odd], lower[odd].astype(np.float32))
    even = seen & (count % 2 == 0)
    assert (depth[even] <= np.float32(upper[even])).all()
    k, reduced = frames[0].camera.intrinsics[0], found.camera.intrinsics[0]
    assert torch.allclose(reduced[:2, :2], k[:2, :2] / factor)
    assert torch.allclose(reduced[:2, 2] + 0.5, (k[:2, 2] + 0.5) / factor)  # centers of pixels are whole numbers


def test_decimation_by_4_and_more_takes_their_mean(frames):
    pixels = blocks(frames[0].depth[0].numpy(), 4)
    count = (~np.isnan(pixels)).sum(-1)
    mean = np.nansum(pixels, axis=-1) / np.maximum(count, 1)
    found = T.DecimateDepth(factor=4, rule="mean")(frames[0]).depth[0].numpy()
    assert np.array_equal(found > 0, count > 0)
    np.testing.assert_allclose(found, mean, rtol=1e-6)


def smoothed(image: np.ndarray, alpha: float, delta: float) -> np.ndarray:
    """Along the first axis and back: a pixel leans on its neighbor where both have readings less than delta apart."""
    for step in (1, -1):
        raw = image[::step]
        out = raw.copy()
        for place in range(1, len(raw)):
            close = (raw[place - 1] > 0) & (raw[place] > 0) & (np.abs(raw[place] - raw[place - 1]) < delta)
            out[place] = np.where(close, alpha * raw[place] + (1 - alpha) * out[place - 1], raw[place])
        image = out[::step]
    return image


@pytest.mark.parametrize(("alpha", "delta"), [(0.5, 20.0), (0.25, 50.0), (0.9, 1.0)])
def test_the_spatial_filter_goes_twice_along_rows_and_columns_and_stops_at_edges_and_holes(frames, alpha, delta):
    (disparity, *_) = disparities(frames)
    image = disparity[0].double().numpy()
    for _ in range(2):
        image = smoothed(smoothed(image.T, alpha, delta).T, alpha, delta)
    found = spatial_filter(disparity, alpha=alpha, delta=delta, iterations=2)[0].double().numpy()
    assert np.array_equal(found > 0, disparity[0].numpy() > 0), "holes neither grow nor shrink"
    # A step that rounding puts on the other side of delta changes its surroundings: almost none may.
    same = np.isclose(found, image, rtol=1e-5)
    assert same.mean() > 0.9999


def test_the_temporal_filter_averages_small_changes_and_bridges_gaps_by_its_rule(frames):
    """Persistence 3, the default: a lost reading is repeated if 2 of the last 4 frames had one."""
    alpha, delta = 0.4, 20.0
    state, last, seen = None, None, []
    for disparity in disparities(frames):
        found, state = temporal_filter(disparity, state, alpha=alpha, delta=delta, persistence=3)
        now = disparity[0].double().numpy()
        if last is None:
            last = np.zeros_like(now)
        valid = now > 0
        steady = valid & (last > 0) & (np.abs(now - last) < delta)
        expected = np.where(steady, alpha * now + (1 - alpha) * last, now)
        credible = sum(seen[-4:], np.zeros(now.shape, int)) >= 2
        expected = np.where(~valid & credible & (last > 0), last, expected)
        assert np.isclose(found[0].numpy(), expected, rtol=1e-5).mean() > 0.9999
        last = np.where(valid, expected, last)
        # A new surface starts its own history.
        seen = [np.where(valid & ~steady, 0, one) for one in seen] + [valid.astype(int)]


def test_holes_are_filled_from_the_left_by_copying(frames):
    depth = frames[0].depth
    found, _ = fill_holes(depth, rule="left")
    image = depth[0].numpy()
    columns = np.maximum.accumulate(np.where(image > 0, np.arange(image.shape[1]), -1), axis=1)
    copied = np.take_along_axis(image, columns.clip(0), axis=1)
    assert np.array_equal(found[0].numpy(), np.where(columns >= 0, copied, 0))


@pytest.mark.parametrize(("rule", "best", "none"), [("farthest", np.max, -np.inf), ("nearest", np.min, np.inf)])
def test_the_rim_of_a_hole_takes_the_farthest_or_the_nearest_reading_beside_it(frames, rule, best, none):
    depth = frames[0].depth
    found = fill_holes(depth, rule=rule)[0][0].numpy()
    image = depth[0].numpy()
    padded = np.pad(np.where(image > 0, image, none), 1, constant_values=none)
    beside = best([padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]], axis=0)
    rim = (image == 0) & np.isfinite(beside)
    assert rim.any()
    assert np.array_equal(found[rim], beside[rim])
    assert np.array_equal(found[image > 0], image[image > 0])


def test_the_threshold_keeps_readings_within_its_range_untouched(frames):
    depth = frames[0].depth
    middle = float(depth[depth > 0].median())
    found = T.MaskDepth(near=0.1, far=middle)(frames[0]).depth
    kept = (depth >= 0.1) & (depth <= middle)
    assert torch.equal(found, torch.where(kept, depth, 0.0))
    assert 0.3 < float(kept.float().mean()) < 0.7
