"""Figures: what is in front is drawn, colors say what they should, and nothing is kept by pyplot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pcdata import Compose, DepthFrame, PointCloud
from pcdata.errors import ConfigError, DTypeError, MissingExtraError
from pcdata.report import figure
from pcdata.report.figures.cloud_picture import cloud_picture
from pcdata.report.figures.coloring import PALETTE, coloring_of
from pcdata.report.html.scene import stage_of
from pcdata.report.html.unpacking import unpack_cloud
from pcdata.structures.kinds import Kind
from pcdata.transforms import Deproject, EstimateNormals, FarthestPointSample
from pcdata.validation import validate_source
from pcdata.validation.grading import Grading
from tests.factories import tabletop_frame
from tests.report.html.decoding import decoded

pytest.importorskip("matplotlib")

RED, BLUE = torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 0, 1.0])


def square(z: float, color: torch.Tensor, *, half: float = 0.5, side: int = 60) -> PointCloud:
    axis = torch.linspace(-half, half, side)
    points = torch.cartesian_prod(axis, axis, torch.tensor([z]))
    return PointCloud(points=points, colors=color.expand(len(points), 3), frame_id="base")


def stacked(high: torch.Tensor, low: torch.Tensor) -> PointCloud:
    """A small square half a metre above a large one."""
    parts = [square(0.0, low), square(0.02, high, half=0.25)]
    return PointCloud(
        points=torch.cat([one.points for one in parts]),
        colors=torch.cat([one.colors for one in parts]),
        frame_id="base",
    )


def share(image: np.ndarray, channel: int) -> float:
    """Which share of the covered pixels has mostly this channel."""
    covered = image[..., 3] > 128
    most = image[..., :3].argmax(-1) == channel
    return float((most & covered).sum() / covered.sum())


def test_what_is_in_front_hides_what_is_behind():
    for high, low, channel in ((RED, BLUE, 0), (BLUE, RED, 2)):
        picture = cloud_picture(
            stage_of(
                "",
                stacked(high, low),
            ),
            color="colors",
            size=(120, 160),
            point_size=None,
        )
        # A quarter of the area, somewhat more since it is nearer.
        assert 0.22 < share(picture.image, channel) < 0.33


def test_a_surface_is_closed_and_fills_the_picture():
    picture = cloud_picture(stage_of("", square(0.0, RED)), color=None, size=(120, 160), point_size=None)
    rows, columns = np.nonzero(picture.image[..., 3] > 128)
    assert columns.max() - columns.min() > 0.85 * 160 or rows.max() - rows.min() > 0.85 * 120
    for row in range(rows.min() + 5, rows.max() - 5):
        covered = np.flatnonzero(picture.image[row, :, 3] > 128)
        assert len(covered) == covered[-1] - covered[0] + 1, f"row {row} has holes"


def test_lines_behind_points_are_told_apart():
    lines = {
        name: hidden
        for name, _, _, hidden in cloud_picture(
            stage_of("", square(0.1, RED)), color=None, size=(120, 160), point_size=None
        ).lines
    }
    assert lines["x axis"].all()  # below the square
    above = {
        name: hidden
        for name, _, _, hidden in cloud_picture(
            stage_of("", square(-0.1, RED)), color=None, size=(120, 160), point_size=None
        ).lines
    }
    assert not above["z axis"].any()


def test_colors_are_those_of_the_viewer():
    cloud = PointCloud(points=torch.rand(5, 3), labels=torch.tensor([-1, 0, 1, 12, 13]), frame_id="base")
    unpacked = unpack_cloud(stage_of("", cloud).cloud)
    coloring = coloring_of(unpacked, "labels", np.array([0, 0, 1.0]))
    assert [color for _, color in coloring.entries] == ["#9498a0", PALETTE[0], PALETTE[1], PALETTE[0], PALETTE[1]]
    assert coloring.colors[1].tolist() == [0x42, 0x69, 0xD0]
    height = coloring_of(unpacked, "height", np.array([0, 0, 1.0]))
    assert height.span is not None
    order = height.colors[cloud.points[:, 2].argsort().numpy()]
    assert order[0].tolist() == [68, 1, 84]
    assert order[-1].tolist() == [253, 231, 37]


def test_unpacked_is_what_the_page_shows():
    cloud = Compose([Deproject(), EstimateNormals(radius=0.05)])(tabletop_frame(1))
    stage = stage_of("", cloud, most_points=1000)
    truth, found = decoded(stage.cloud), unpack_cloud(stage.cloud)
    assert np.array_equal(found.points, truth.pop("points"))
    assert set(found.fields) == set(truth)
    for name, values in truth.items():
        assert np.array_equal(np.squeeze(found.fields[name]), np.squeeze(values)), name


def titles(drawn) -> list[str]:
    return [axis.get_title().split("\n")[0] for axis in drawn.axes if axis.get_title()]


def test_a_capture_has_its_images_and_its_cloud(monkeypatch):
    from matplotlib import pyplot

    frame = tabletop_frame(2)
    read = [f"{float((depth > 0).float().mean()):.1%}" for depth in frame.depth]
    assert titles(figure(frame, color=["colors", "height"])) == [
        *(f"view 0: depth, {read[0]} read (magenta: none)", "view 0: rims of depth (red) over color"),
        *(f"view 1: depth, {read[1]} read (magenta: none)", "view 1: rims of depth (red) over color"),
        *("capture", "capture"),
    ]
    assert pyplot.get_fignums() == []


def test_steps_have_a_panel_each_and_their_counts():
    chain = Compose([Deproject(), FarthestPointSample(num_points=300)])
    frame = tabletop_frame(1)
    assert titles(figure(chain.step_through(frame))) == ["Deproject", "FarthestPointSample", "points after each step"]
    assert titles(figure([("before", chain(frame)), ("$x$", chain(frame))]))[:2] == ["before", r"\$x\$"]


class One:
    """A source of captures."""

    name, ids = "one", ["a", "b"]

    def __len__(self) -> int:
        return 2

    def load(self, sample_id: str) -> DepthFrame:
        return tabletop_frame(1)


def test_a_grading_is_drawn_by_its_trends():
    grading = Grading(One.ids)
    for report in validate_source(One()):
        grading.add(report)
    assert any(title.startswith("valid_fraction") for title in titles(figure(grading)))


@pytest.mark.parametrize("count", [0, 1, 7])
def test_few_points_are_drawn_too(tmp_path, count):
    cloud = PointCloud(points=torch.ones(count, 3), frame_id="base")
    figure(cloud, title="few").savefig(tmp_path / "few.png")


@pytest.mark.parametrize("far", [1e12, 1e30, 3e38])
def test_a_stray_at_the_end_of_floats_is_drawn(tmp_path, far):
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    cloud = PointCloud(points=torch.cat([points, torch.tensor([[far, 0.0, 0.0]])]), frame_id="base")
    figure(cloud).savefig(tmp_path / "stray.png")


def test_numbers_that_are_none_keep_the_colors_of_the_others():
    values = torch.linspace(0, 1, 100)
    cloud = PointCloud(points=torch.rand(100, 3), extra={"c": values}, kinds={"c": Kind.INVARIANT}, frame_id="base")
    with_none = replace(cloud, extra={"c": torch.where(torch.arange(100) == 50, torch.nan, values)})
    one, other = (
        coloring_of(unpack_cloud(stage_of("", each).cloud), "c", np.array([0, 0, 1.0])) for each in (cloud, with_none)
    )
    assert other.span == pytest.approx(one.span, abs=0.02)
    assert [*other.colors[50]] == [0x94, 0x98, 0xA0]  # gray, as in the viewer
    figure(with_none, color="c")


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_unit_of_length_does_not_matter(scale):
    cloud = square(0.0, RED)
    large = PointCloud(points=cloud.points * scale, colors=cloud.colors, frame_id="base")
    one, other = (
        cloud_picture(stage_of("", each), color=None, size=(60, 80), point_size=None).image[..., 3].astype(float)
        for each in (cloud, large)
    )
    assert abs(one - other).mean() < 2


def test_a_color_that_is_not_there_is_refused_with_those_that_are():
    with pytest.raises(ConfigError, match=r"it has colors, height, distance; did you mean 'colors'\?"):
        figure(square(0.0, RED), color="color")


@pytest.mark.parametrize("wrong", [None, 5, [1], [("a", 2)], [torch.zeros(3, 3)]])
def test_something_else_is_refused(wrong):
    with pytest.raises(DTypeError, match="takes a PointCloud, a DepthFrame"):
        figure(wrong)


def test_without_matplotlib_the_command_is_told(monkeypatch):
    import importlib.util

    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "matplotlib" else find(name))
    with pytest.raises(MissingExtraError, match=r"pcdata\[viz\]"):
        figure(square(0.0, RED))
