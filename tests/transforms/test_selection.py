"""Steps that remove points by what they are, and the limit to what any step may remove."""

from __future__ import annotations

import warnings

import pytest
import torch

from pcdata import transforms as T
from pcdata.errors import ConfigError, DTypeError, ShapeError, TooFewPointsError
from pcdata.structures import PointCloud
from tests.factories import cloud_in_base
from tests.transforms.examples import BOX


def test_removing_more_than_the_limit_is_an_error_or_a_warning_that_names_the_cloud():
    data = cloud_in_base((120, 90))
    crop = {"frame": "base", **BOX}
    kept = T.CropWorkspace(**crop)(data)
    part = (1 - kept.counts / data.counts).tolist()
    at_most = max(part)
    worst = part.index(at_most)
    assert T.CropWorkspace(**crop, max_drop=at_most + 1e-6)(data).num_points == kept.num_points
    text = rf"CropWorkspace: \d+ of the \d+ points of cloud {worst} .*more than max_drop"
    with pytest.raises(TooFewPointsError, match=text):
        T.CropWorkspace(**crop, max_drop=at_most - 0.01)(data)
    with pytest.warns(T.LeftOutWarning, match=text):
        warned = T.CropWorkspace(**crop, max_drop=at_most - 0.01, drop_alarm="warn")(data)
    assert warned.num_points == kept.num_points


def test_the_limit_holds_where_steps_run_together():
    from tests.factories import tabletop_frame

    frame = tabletop_frame(1)
    crop = {"frame": "camera", "lower": (-0.1, -0.1, 0.1), "upper": (0.1, 0.1, 2.0)}
    T.Compose([T.Deproject(), T.CropWorkspace(**crop)])(frame)
    with pytest.raises(TooFewPointsError, match=r"more than max_drop=0\.1"):
        T.Compose([T.Deproject(), T.CropWorkspace(**crop, max_drop=0.1)])(frame)
    inside = T.Compose([T.Deproject(), T.CropWorkspace(**crop)])(frame).num_points
    outside = T.Compose([T.Deproject(), T.CropWorkspace(**crop, invert=True)])(frame).num_points
    assert inside + outside == T.Deproject()(frame).num_points


def test_a_box_per_cloud_comes_from_signals_and_moves_with_the_clouds():
    data = cloud_in_base((120, 90))
    lower = torch.tensor([[-0.1, -0.1, -1.0], [0.0, 0.0, -1.0]])
    boxed = data.with_signal("low", lower, "position").with_signal("high", lower + 2.0, "position")
    crop = T.CropWorkspace(frame="base", lower="low", upper="high")
    result = crop(boxed)
    for b, one in enumerate(data):
        alone = T.CropWorkspace(frame="base", lower=tuple(lower[b].tolist()), upper=tuple((lower[b] + 2.0).tolist()))
        assert torch.equal(result[b].points, alone(one).points)
    shift = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    shift[:, :3, 3] = 0.25
    assert torch.equal(crop(boxed.transformed(shift)).extra["row"], result.extra["row"])
    with pytest.raises(DTypeError, match="no signal 'low'; it has none; attach one by with_signal"):
        crop(data)
    with pytest.raises(ShapeError, match=r"signal 'low' must be a corner per cloud \(2, 3\)"):
        crop(boxed.with_signal("low", lower[:, :2], "invariant"))
    with pytest.raises(ConfigError, match="both numbers, or both names"):
        T.CropWorkspace(frame="base", lower="low", upper=(1.0, 1.0, 1.0))


@pytest.mark.parametrize(("axis", "columns"), [("z", (0, 1)), ("x", (1, 2)), ("y", (2, 0))])
def test_a_prism_is_cut_along_its_axis(axis, columns):
    data = cloud_in_base((200,))
    square = ((-0.1, -0.1), (0.1, -0.1), (0.1, 0.1), (-0.1, 0.1))
    height = data.points[:, "xyz".index(axis)]
    middle = float(height.median())
    result = T.CropPolygon(frame="base", polygon=square, axis=axis, low=middle)(data)
    wanted = (data.points[:, columns].abs() < 0.1).all(1) & (height >= middle)
    assert result.extra["row"].tolist() == data.extra["row"][wanted].tolist()


def on_a_table() -> PointCloud:
    """A round table, things on it, and things beside it at the same height."""
    generator = torch.Generator().manual_seed(0)
    disk = torch.rand(2000, 3, generator=generator) - 0.5
    disk = disk[disk[:, :2].norm(dim=1) < 0.5] * torch.tensor([1.0, 1.0, 0.002])
    on = torch.rand(60, 3, generator=generator) * 0.2 + torch.tensor([0.0, 0.0, 0.05])
    high, beside = on + torch.tensor([0.0, 0.0, 1.0]), on + torch.tensor([0.6, 0.0, 0.0])
    parts = [disk, on, high, beside, on - torch.tensor([0.0, 0.0, 0.5])]
    labels = torch.repeat_interleave(torch.arange(5), torch.tensor([len(part) for part in parts]))
    return PointCloud(points=torch.cat(parts), labels=labels, frame_id="base")


def test_what_stands_on_the_table_is_over_its_hull():
    plane = {"up": (0.0, 0.0, 1.0), "frame": "base", "distance": 0.01}
    cloud = on_a_table()
    assert set(T.RemovePlane(keep="above", **plane)(cloud).labels.tolist()) == {1, 2, 3}
    assert set(T.RemovePlane(keep="over", **plane)(cloud).labels.tolist()) == {1, 2}
    on = T.RemovePlane(keep="over", max_height=0.5, **plane)(cloud)
    assert on.labels.tolist() == [1] * 60
    near = T.RemovePlane(keep="over", max_height=0.5, margin=0.5, **plane)(cloud)
    assert set(near.labels.tolist()) == {1, 3}
    for wrong in ({"max_height": 0.5}, {"margin": 0.1, "keep": "above"}):
        with pytest.raises(ConfigError, match="say keep: "):
            T.RemovePlane(**plane, **wrong)


def test_points_are_kept_by_label_view_and_range():
    data = cloud_in_base((120, 90))
    some = data.labels.unique().tolist()[:1]
    one, others = (T.KeepValues(values=tuple(some), invert=invert)(data) for invert in (False, True))
    assert set(one.labels.tolist()) == set(some)
    assert one.num_points + others.num_points == data.num_points
    weight = data.extra["weight"]
    middle = float(weight.median())
    ranged = T.KeepValues(field="weight", low=middle)(data) if weight.ndim == 1 else None
    assert ranged is None or torch.equal(ranged.extra["weight"], weight[weight >= middle])
    with pytest.raises(DTypeError, match=r"no field 'view'; it has .*; MergeViews writes it"):
        T.KeepValues(field="view", values=(0,))(data)
    with pytest.raises(DTypeError, match=r"field 'colors' has \(3,\) numbers per point"):
        T.KeepValues(field="colors", low=0.5)(data)
    for wrong in ({}, {"values": (1,), "low": 0.0}, {"low": 1.0, "high": 0.0}):
        with pytest.raises(ConfigError, match="KeepValues: "):
            T.KeepValues(**wrong)


def test_points_that_are_no_numbers_are_dropped_and_counted():
    data = cloud_in_base((120, 90))
    points = data.points.clone()
    points[3, 1], points[200, 2] = torch.nan, torch.inf
    spoiled = data.with_fields(points=points)
    clean = T.DropNonFinite()(spoiled)
    assert clean.counts.tolist() == [119, 89]
    assert [steps[-1]["points_before"] for steps in clean.history] == [120, 90]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        T.EstimateNormals(radius=0.1)(clean)
    with pytest.raises(TooFewPointsError, match="DropNonFinite: 1 of the 120 points of cloud 0"):
        T.DropNonFinite(max_drop=0.0)(spoiled)


def test_repeats_are_dropped():
    data = cloud_in_base((50,))
    again = data.select(torch.tensor([*range(50), 3, 3, 7]), torch.tensor([0, 53]))
    assert torch.equal(T.RemoveDuplicates()(again).extra["row"], data.extra["row"])
