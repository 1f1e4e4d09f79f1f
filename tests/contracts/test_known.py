"""Within a run of a chain values are read once; outside of it, and where others have the data in hand, every time."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

import pcdata
from pcdata.contracts import tensors
from pcdata.contracts.known import FINITE, forget, is_known, keeping_known, knowing_nothing, note
from pcdata.errors import ConfigError, NonFiniteError, ShapeError
from pcdata.functional import radius_outlier_mask
from pcdata.synthetic import tabletop
from pcdata.transforms.base import REGISTRY


@pytest.fixture(scope="module")
def scene():
    return tabletop(3, noise="stereo", num_views=1, size=(60, 80)).frame


def beginning():
    return [
        pcdata.MaskDepth(near=0.2, far=2.0),
        pcdata.RemoveFlyingPixels(),
        pcdata.Deproject(),
        pcdata.CropWorkspace(frame="camera", lower=(-0.4, -0.4, 0.2), upper=(0.4, 0.4, 1.5)),
    ]


def test_nothing_is_known_outside_a_run():
    values = torch.ones(3)
    note(FINITE, values)
    assert not is_known(FINITE, values)
    with keeping_known():
        note(FINITE, values)
        assert is_known(FINITE, values)
        with keeping_known():
            assert not is_known(FINITE, values)
        with knowing_nothing():
            note(FINITE, values)
            assert not is_known(FINITE, values)
        assert not is_known(FINITE, values)
    assert not is_known(FINITE, values)


def test_a_tensor_that_changed_is_unknown():
    with keeping_known():
        values = torch.ones(4, 3)
        note(FINITE, values)
        assert not is_known(FINITE, values.clone())
        values[0, 0] = torch.nan
        assert not is_known(FINITE, values)
        part = torch.ones(4, 3)
        note(FINITE, part)
        part[1:].fill_(torch.nan)  # through a view
        assert not is_known(FINITE, part)


def test_a_fact_about_two_holds_for_these_two_alone():
    with keeping_known():
        rows, ptr = torch.arange(4), torch.tensor([0, 4])
        note("rise", rows, ptr)
        assert is_known("rise", rows, ptr)
        assert not is_known("rise", rows, ptr.clone())
        assert not is_known("rise", ptr, rows)
        forget()
        assert not is_known("rise", rows, ptr)


def test_what_died_is_unknown_whoever_has_its_place_in_memory():
    with keeping_known():
        places = set()
        for _ in range(100):
            values = torch.full((3,), torch.nan)
            assert not is_known(FINITE, values)
            places.add(id(values))
            note(FINITE, values)
            del values
        assert len(places) < 100  # or the test says nothing


def test_tensors_of_inference_mode_are_read_every_time():
    with keeping_known(), torch.inference_mode():
        values = torch.ones(3)
        note(FINITE, values)
        assert not is_known(FINITE, values)


def test_a_chain_reads_no_values_only_to_look_at_them(scene, monkeypatch):
    read = []
    monkeypatch.setattr(tensors, "all_finite", lambda values: read.append(values.shape) or True)
    chain = pcdata.Compose(
        [
            *beginning(),
            pcdata.RemoveStatisticalOutliers(),
            pcdata.RemoveRadiusOutliers(min_neighbors=2, radius=0.05),
            pcdata.RemovePlane(num_hypotheses=100),
            pcdata.FarthestPointSample(num_points=64),
            pcdata.EstimateNormals(radius=0.1),
        ]
    )
    chain(scene)
    large = [shape for shape in read if shape.numel() > 64 * 3]
    assert large == []  # what is within a box, or within a range of depth, is finite


@pytest.mark.parametrize("how", ["step", "hook"])
def test_what_others_write_into_the_data_is_seen(scene, how):
    def spoil(cloud):
        cloud.points.numpy()[0] = np.nan  # torch counts no change
        return cloud

    last = pcdata.RemoveRadiusOutliers(min_neighbors=2, radius=0.05)
    if how == "hook":
        before = pcdata.RemoveStatisticalOutliers()
        before.register_forward_hook(lambda step, given, cloud: spoil(cloud))
    else:

        class Spoil(pcdata.Transform):
            def transform(self, data, params):
                return spoil(data)

        before = Spoil()
        del REGISTRY["Spoil"]
    with pytest.raises(NonFiniteError, match="points has 3 NaN"):
        pcdata.Compose([*beginning(), before, last])(scene)


def test_what_is_written_between_two_runs_is_seen(scene):
    outliers = pcdata.Compose([pcdata.RemoveRadiusOutliers(min_neighbors=2, radius=0.05)])
    cloud = outliers(pcdata.Compose(beginning())(scene))
    outliers(cloud)
    cloud.source_index.numpy()[0] = 4000
    with pytest.raises(ShapeError, match="grid pixels must increase"):
        outliers(cloud)
    with pytest.raises(ShapeError, match="grid pixels must increase"):
        radius_outlier_mask(cloud.points, cloud.ptr, grid=cloud.image_grid())
    spoiled = dataclasses.replace(cloud, layout=None)
    spoiled.points.numpy()[5] = np.inf
    with pytest.raises(NonFiniteError):
        outliers(spoiled)


def test_a_pose_that_is_no_motion_makes_no_grid_within_a_chain(scene):
    cloud = pcdata.Compose(beginning())(scene)
    wide = cloud.source_from_cloud.clone()
    wide[0, 0, 0] = 1.5
    spoiled = dataclasses.replace(cloud, source_from_cloud=wide)
    with pytest.raises(ConfigError, match="is not rigid"):
        pcdata.Compose([pcdata.RemoveRadiusOutliers(min_neighbors=2, radius=0.05)])(spoiled)
