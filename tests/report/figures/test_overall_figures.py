"""Pictures of all captures together show the numbers that were gathered: read back from what was drawn."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pcdata.report.html.gathering import Gathered, gather_captures
from pcdata.report.html.panels.cameras import series_of
from pcdata.validation import SampleReport
from pcdata.validation.grading import Grading
from pcdata.verdicts import Finding, Verdict
from tests.report.html.recorded import MOVED_FROM, NUM_FRAMES, Recorded, rig_frames

pytest.importorskip("matplotlib")
from matplotlib.colors import to_rgba

from pcdata.report.figures.overall_figures import (
    cameras_panel,
    episodes_figure,
    gaps_figure,
    numbers_figure,
    objects_figure,
    planes_figure,
)
from pcdata.report.figures.overall_panels import boxes_panel
from pcdata.report.figures.report_pictures import _figures, write_pictures
from pcdata.report.html.charts import VERDICT_COLORS

BOXES = ((0.2, 0.1, 0.05), (0.08, 0.07, 0.12))


@pytest.fixture(scope="module")
def gathered() -> Gathered:
    found = gather_captures(Recorded(rig_frames()), num_shown=2, title="three cameras")
    looked = tuple(replace(one, objects=BOXES if number else ()) for number, one in enumerate(found.looked))
    return replace(found, looked=looked, funnel=(("Deproject", 100.0), ("RemovePlane", 25.0)))


def texts(axis: Any) -> str:
    return "\n".join([axis.get_title(), *(text.get_text() for text in axis.texts)])


def severities(image: Any) -> list[int]:
    colors = [to_rgba(color) for color in VERDICT_COLORS]
    return [colors.index(tuple(pixel)) for pixel in np.asarray(image.get_array())[0].tolist()]


def test_pictures_come_in_the_order_of_the_page(gathered):
    names = [name for name, _ in _figures(gathered)]
    assert names == ["summary", "episodes", "sample_01", "sample_02", "gaps", "planes", "objects", "numbers"]


def test_the_summary_has_reasons_first_then_since_when_each_camera_is_off(gathered):
    _, summary = next(_figures(gathered))
    verdict, cameras, funnel = summary.axes
    assert "fail view_pose view 1 (front), in 3 of 6 captures, from 'f3' on" in " ".join(texts(verdict).split())
    assert "view 1 (front)  fail view_pose: from 'f3' on, in 3 of 6 captures" in texts(cameras)
    left, front, right = cameras.images
    assert severities(front) == [0] * MOVED_FROM + [3] * (NUM_FRAMES - MOVED_FROM)
    assert severities(left) == severities(right) == [0] * NUM_FRAMES
    assert {"f0", f"f{NUM_FRAMES - 1}"} <= {text.get_text() for text in cameras.texts}
    assert "25 (25%)" in texts(funnel)
    summary.canvas.draw()
    assert min(axis.get_position().width for axis in summary.axes) > 0.25  # no text took the room of another panel


def test_an_episode_shows_what_is_missing_and_its_signals(gathered):
    bands, joints = episodes_figure(gathered).axes
    (line,) = gathered.lines
    (image,) = bands.images
    assert severities(image) == line.severities.tolist()
    assert "pick  6 captures, 3.5 s; gaps: f4 after 3.1 s" in texts(bands)
    (marks,) = [drawn for drawn in bands.lines if drawn.get_marker() == "v" and len(drawn.get_xdata())]
    assert marks.get_xdata() == pytest.approx([4 / 6])
    assert joints.get_title() == "pick: joints<b>"
    assert [one.get_ydata().tolist() for one in joints.lines] == [[*range(6)], [-n for n in range(6)]]


def test_gaps_between_cameras_are_those_of_the_pairs(gathered):
    axes = gaps_figure(gathered).axes
    assert len(axes) == 3
    pairs = [pair for one in gathered.looked for pair in one.pairs]
    own = [pair for pair in pairs if (pair.first, pair.second) == ("view 0 (left)", "view 1 (front)")]
    (axis,) = [axis for axis in axes if axis.get_title().startswith("view 0 (left) - view 1 (front)\n")]
    half = 1e3 * np.median([pair.median for pair in own])
    assert f"half within {half:.1f} mm" in axis.get_title()
    (stairs,) = axis.patches
    assert stairs.get_data().values.tolist() == np.sum([pair.histogram for pair in own], axis=0).tolist()


def test_a_pair_that_shares_too_little_has_no_number(gathered):
    lost = [replace(pair, median=float("nan"), p90=float("nan"), overlap=0.01) for pair in gathered.looked[0].pairs[:1]]
    (axis,) = gaps_figure(replace(gathered, looked=(replace(gathered.looked[0], pairs=tuple(lost)),))).axes
    assert "too little to measure: 1 % shared" in axis.get_title()


def test_planes_are_drawn_in_millimetres_for_every_camera(gathered):
    noise, height, tilt = planes_figure(gathered).axes
    for axis, name, factor in ((noise, "plane_noise", 1e3), (height, "plane_height", 1e3), (tilt, "plane_tilt", 1.0)):
        series = series_of(gathered.grading, name)
        assert len(axis.lines) == len(series) == 3
        for line, (view, values) in zip(axis.lines, series.items()):
            assert line.get_label().endswith(f", {view}")
            assert line.get_label().startswith(f"median {factor * np.median(values):.4g}")
            assert line.get_ydata() == pytest.approx(factor * values)
    assert "plane" not in " ".join(axis.get_title() for axis in numbers_figure(gathered).axes)  # each is shown once


def test_objects_are_counted_and_measured(gathered):
    (axis,) = objects_figure(gathered).axes
    assert [label.get_text().split("\n")[1] for label in axis.get_xticklabels()] == ["0 objects", "2 objects"]
    edges = {line.get_label(): line.get_ydata() for line in axis.lines}
    assert edges["length"] == pytest.approx([20.0, 8.0])
    assert edges["width"] == pytest.approx([10.0, 7.0])
    assert edges["height"] == pytest.approx([5.0, 12.0])


def graded(findings: dict[str, list[float]], view: int | None = None, names: tuple[str, ...] = ()) -> Grading:
    count = len(next(iter(findings.values())))
    grading = Grading([f"s{number}" for number in range(count)])
    for number in range(count):
        found = [
            Finding(
                name=name,
                view=view,
                verdict=Verdict.PASS if np.isfinite(values[number]) else Verdict.UNKNOWN,
                value=values[number] if np.isfinite(values[number]) else None,
            )
            for name, values in findings.items()
        ]
        grading.add(SampleReport(f"s{number}", tuple(found), views=names))
    return grading


def bare(grading: Grading) -> Gathered:
    return Gathered(title="", source="", grading=grading, looked=(), funnel=(), left_out={}, pipeline="", lines=())


def test_counts_and_sizes_over_a_dataset_are_histograms():
    counts, sizes = objects_figure(bare(graded({"object_count": [2, 2, 4], "object_size": [0.1, 0.1, 0.3]}))).axes
    stairs = counts.patches[0].get_data()
    assert stairs.values.tolist() == [2, 0, 1]
    assert stairs.edges.tolist() == [1.5, 2.5, 3.5, 4.5]
    stairs = sizes.patches[0].get_data()
    assert stairs.values.sum() == 3
    assert (stairs.edges[0], stairs.edges[-1]) == pytest.approx((10.0, 30.0))  # cm


def test_a_measurement_between_two_that_failed_is_a_dot():
    nan = float("nan")
    (axis,) = planes_figure(bare(graded({"plane_tilt": [1.0, 2.0, nan, 3.0, nan]}, 0, ("view 0",)))).axes
    (line,) = axis.lines
    assert line.get_ydata() == pytest.approx([1.0, 2.0, nan, 3.0, nan], nan_ok=True)
    assert line.get_markevery() == [3]
    axis.figure.canvas.draw()


def test_nothing_is_drawn_of_what_was_not_gathered(tmp_path):
    nothing = bare(graded({"depth_valid": [0.5]}))
    draws = (episodes_figure, gaps_figure, planes_figure, objects_figure, cameras_panel)
    assert [draw(nothing) for draw in draws] == [None] * len(draws)
    for name in ("objects.png", "gaps.png", "own.png"):  # of a run that had them, and of somebody else
        (tmp_path / name).write_bytes(b"before")
    assert [path.name for path in write_pictures(nothing, tmp_path)] == ["summary.png", "numbers.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["numbers.png", "own.png", "summary.png"]


def test_of_long_recordings_and_many_cameras_the_worst_stay_seen():
    names = tuple(f"view {view}" for view in range(20))
    grading = Grading([str(number) for number in range(2000)])
    for number in range(2000):
        bad = Verdict.FAIL if number == 1234 else Verdict.PASS
        found = [
            Finding(name="depth_valid", view=view, verdict=bad if view == 19 else Verdict.PASS) for view in range(20)
        ]
        grading.add(SampleReport(str(number), tuple(found), views=names))
    panel = cameras_panel(bare(grading))
    assert panel is not None
    from matplotlib.figure import Figure

    axis = Figure().subplots()
    panel[0](axis)
    assert axis.get_title() == "cameras over the captures: the worst 16 of 20"
    worst, *others = [severities(image) for image in axis.images]
    assert len(others) == 15
    assert worst.count(3) == 1
    assert not any(map(any, others))


def test_samples_without_objects_are_drawn_too():
    from matplotlib.figure import Figure

    axis = Figure().subplots()
    boxes_panel(axis, [("a", ())])
    assert axis.get_xticklabels()[0].get_text() == "a\n0 objects"
