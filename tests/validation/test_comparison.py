"""Two sources side by side: what differs is named with what closes it, and what does not is not."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

from pcdata.errors import CaptureError, ConfigError, DTypeError
from pcdata.report.html.compare_page import compare_page
from pcdata.rng import generator_for
from pcdata.structures import DepthFrame, PointCloud
from pcdata.synthetic import SyntheticSource
from pcdata.transforms import Compose, Deproject, RandomSensorNoise, ToFrame
from pcdata.validation.comparison import Comparison, compare_sources
from pcdata.verdicts import Verdict

SIZE = (120, 160)
COUNT = 8


class Source:
    """Captures in memory."""

    def __init__(self, captures: dict[str, Any], name: str = "made") -> None:
        self.captures, self.name, self.ids = captures, name, list(captures)

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id: str) -> Any:
        found = self.captures[sample_id]
        if isinstance(found, Exception):
            raise found
        return found

    def through(self, make: Callable[[Any, str], Any]) -> Source:
        return Source({name: make(one, name) for name, one in self.captures.items()}, self.name)


@cache
def tables(seed: int, count: int = COUNT) -> Source:
    made = SyntheticSource(num_scenes=count, seed=seed, size=SIZE)
    return Source({one: made.load(one) for one in made.ids}, "tables")


def raised(millimetres: float) -> Callable[[DepthFrame, str], DepthFrame]:
    def make(frame: DepthFrame, _: str) -> DepthFrame:
        assert frame.world_from_camera is not None
        poses = frame.world_from_camera.clone()
        poses[:, 2, 3] += millimetres / 1e3
        return replace(frame, world_from_camera=poses)

    return make


def noisy(frame: DepthFrame, sample_id: str) -> DepthFrame:
    return RandomSensorNoise(sensor="realsense_d435")(frame, generator=generator_for(5, 2, sample_id))


def names(result: Comparison) -> set[str]:
    return {one.name for one in result.differences}


@cache
def of_noise() -> Comparison:
    return compare_sources(tables(0), tables(50).through(noisy))


def test_other_scenes_of_one_kind_do_not_differ():
    result = compare_sources(tables(0), tables(50))
    assert result.verdict is Verdict.PASS
    assert result.differences == ()
    assert result.text().splitlines()[0] == "compare: pass"


def test_a_sensors_noise_is_named_with_the_step_that_makes_it():
    result = of_noise()
    assert {"noise", "holes"} <= names(result) <= {"noise", "holes", "flying pixels"}
    (noise,) = (one for one in result.differences if one.name == "noise")
    (fields,) = noise.step.values()
    assert (noise.on, noise.closed, [*noise.step]) == ("A", True, ["RandomSensorNoise"])
    assert fields["sensor"].startswith("realsense_d4")
    assert fields["strength"] == pytest.approx(1.0, abs=0.25)
    assert fields["edge_dropout"] == pytest.approx(0.4, abs=0.15)


def test_noise_that_is_advised_closes_the_difference_with_other_draws():
    step = Compose.from_config([next(one.step for one in of_noise().differences if one.step)])
    followed = tables(0).through(lambda frame, name: step(frame, generator=generator_for(11, 4, name)))
    assert names(compare_sources(followed, tables(50).through(noisy))) == set()


def test_an_offset_of_the_frame_is_measured_and_closed_by_its_step():
    b = tables(50).through(raised(20))
    result = compare_sources(tables(0), b)
    (offset,) = result.differences
    assert (offset.name, offset.on, offset.closed) == ("offset", "A", True)
    assert offset.step["RandomTranslation"]["min_offset"] == pytest.approx([0, 0, 0.02], abs=0.001)
    to_base = Compose([Deproject(), ToFrame(frame="base")])
    moved = Compose.from_config([offset.step])
    a_clouds = tables(0).through(lambda frame, name: moved(to_base(frame), generator=generator_for(0, 0, name)))
    assert names(compare_sources(a_clouds, b.through(lambda frame, _: to_base(frame)))) == set()
    unmoved = tables(0).through(lambda frame, _: to_base(frame))
    assert names(compare_sources(unmoved, b.through(lambda frame, _: to_base(frame)))) == {"offset"}


@pytest.mark.parametrize("times", [0.1, 5.0])
def test_another_unit_explains_what_follows_from_it(times):
    result = compare_sources(tables(0), tables(50).through(lambda one, _: replace(one, depth=one.depth * times)))
    (unit,) = result.differences
    assert unit.name == "unit"
    assert f"times {1 / times:g}" in unit.advice
    assert any("height of the table" in one for one in unit.explains)


def test_a_scene_that_is_four_times_farther_away_is_no_other_unit():
    def far(frame: DepthFrame, _: str) -> DepthFrame:
        noise = torch.randn(frame.depth.shape, generator=torch.Generator().manual_seed(0))
        return replace(frame, depth=3.6 + 0.01 * noise, world_from_camera=None, frame_id=None)

    def near(frame: DepthFrame, _: str) -> DepthFrame:
        return replace(frame, world_from_camera=None, frame_id=None)

    result = compare_sources(tables(0).through(near), tables(50).through(far))
    assert "distances" in names(result)
    assert "unit" not in names(result)


def test_captures_that_no_unit_can_be_read_in_are_another_unit():
    class Millimetres(Source):
        def load(self, sample_id: str) -> Any:
            frame = super().load(sample_id)
            return replace(frame, depth=frame.depth * 1000)

    result = compare_sources(tables(0), Millimetres(tables(50).captures))
    assert names(result) == {"unit"}
    assert result.verdict is Verdict.FAIL


def test_colors_and_frames_are_named_alone():
    def dark(frame: DepthFrame, _: str) -> DepthFrame:
        assert frame.colors is not None
        return replace(frame, colors=(frame.colors * 0.6).to(torch.uint8), frame_id="world")

    result = compare_sources(tables(0), tables(50).through(dark))
    assert names(result) == {"colors", "frame"}
    assert "RandomColorJitter(brightness=" in result.text()
    assert any("other frames" in one for one in result.not_compared)


def test_single_captures_say_what_they_can_and_that_more_is_needed():
    one, other = tables(0, 1), tables(50, 1)
    (own,) = one.captures.values()
    result = compare_sources(one, other.through(lambda frame, _: replace(frame, camera=own.camera)))
    assert result.verdict is Verdict.UNKNOWN
    assert "not judged:" in result.text()
    assert names(result) == set()
    assert names(compare_sources(one, tables(50))) == set()  # within what eight others differ by
    assert "offset" in names(compare_sources(one.through(raised(20)), tables(50)))


def test_images_are_compared_with_clouds_by_their_points():
    clouds = tables(50).through(lambda frame, _: ToFrame(frame="base")(Deproject()(frame)))
    result = compare_sources(tables(0), clouds)
    assert names(result) == set()
    assert any("images of A" in one for one in result.not_compared)


def test_so_many_captures_are_measured_as_asked_for():
    seen = []
    result = compare_sources(tables(0), tables(50), captures=3, progress=lambda *told: seen.append(told))
    assert (result.captures, result.of) == ((3, 3), (COUNT, COUNT))
    assert [done for done, _, _ in seen] == [1, 2, 3, 4, 5, 6]
    assert "3 of 8 captures" in result.text()


def test_captures_that_cannot_be_read_are_counted():
    captures = {**tables(0).captures, "broken": CaptureError("no such file")}
    result = compare_sources(Source(captures), tables(50))
    assert result.refused[0] == {"broken": "CaptureError: no such file"}
    assert "1 could not be read" in result.text()
    with pytest.raises(CaptureError, match=r"no capture of .* can be read; the first: CaptureError: gone"):
        compare_sources(Source({"a": CaptureError("gone")}), tables(50))


def test_what_is_no_source_is_refused():
    with pytest.raises(DTypeError, match="ids and load"):
        compare_sources(3, tables(0))  # type: ignore[arg-type]
    with pytest.raises(CaptureError, match="no samples"):
        compare_sources(Source({}), tables(0))
    with pytest.raises(ConfigError, match="captures must be 1 or more, got 0"):
        compare_sources(tables(0), tables(50), captures=0)
    with pytest.raises(DTypeError, match="gives a list"):
        compare_sources(Source({"a": []}), tables(0))


def test_empty_and_tiny_captures_are_compared():
    blank = tables(50).through(lambda one, _: replace(one, depth=torch.zeros_like(one.depth)))
    assert "holes" in names(compare_sources(tables(0), blank))
    point = PointCloud(points=torch.zeros(1, 3), frame_id="base")
    few = Source({str(n): point for n in range(4)})
    assert compare_sources(few, few).verdict is not Verdict.FAIL
    none = Source({str(n): PointCloud(points=torch.zeros(0, 3), frame_id="base") for n in range(4)})
    assert compare_sources(none, few).verdict is not None


def test_a_result_is_frozen_and_plain_json():
    result = of_noise()
    with pytest.raises(dataclasses.FrozenInstanceError):
        result.names = ("a", "b")  # type: ignore[misc]
    told = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert told["schema"] == "pcdata.compare/1"
    assert told["verdict"] == "fail"
    assert {"name", "a", "b", "passes", "seen_from", "verdict", "left"} <= set(told["measured"][0])


def test_names_of_sources_are_text_on_the_page():
    page = compare_page(replace(of_noise(), names=("<script>alert(1)</script>", "\u202eb")))
    assert "<script>alert" not in page
    assert "\u202e" not in page
    assert "RandomSensorNoise" in page
    assert "Tried: the difference was gone." in page


def test_a_sample_does_not_depend_on_the_default_dtype():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        other = compare_sources(tables(0), tables(50))
    finally:
        torch.set_default_dtype(before)
    assert [one.a for one in other.measured] == [one.a for one in compare_sources(tables(0), tables(50)).measured]


def test_numbers_are_of_the_captures_and_not_of_their_order():
    backwards = Source(dict(reversed(tables(50).captures.items())))
    forth, back = compare_sources(tables(0), tables(50)), compare_sources(tables(0), backwards)
    assert np.allclose([one.b for one in forth.measured], [one.b for one in back.measured])


@pytest.mark.parametrize("largest", [1e22, 1e30, 3e38])
def test_coordinates_near_the_end_of_what_a_float_holds_are_compared(largest):
    points = largest * torch.rand(500, 3, generator=torch.Generator().manual_seed(0))
    far = Source({str(n): PointCloud(points=points, frame_id="base") for n in range(4)})
    near = Source({str(n): PointCloud(points=points / largest, frame_id="base") for n in range(4)})
    assert compare_sources(far, far).verdict is not Verdict.FAIL
    json.dumps(compare_sources(far, near).to_json(), allow_nan=False)
