"""Checks on a series of captures, on files, and on clouds; one bad capture never ends the run."""

from __future__ import annotations

import itertools
import json
import shutil
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pcdata import open_source, validate_frame, validate_source
from pcdata.errors import CaptureError, DTypeError
from pcdata.geometry import rigid
from pcdata.io import JoinedSource, read_depth, write_pcd
from pcdata.report.validation_text import validation_text
from pcdata.structures import DepthFrame, PointCloud
from pcdata.synthetic import SyntheticSource, look_at, tabletop
from pcdata.validation import WHOLE, CaptureLimits, SampleReport, Summary
from pcdata.verdicts import Finding, Verdict
from tests.validation.captures import Frames, scene, store, verdicts


def shots(count: int = 3) -> list[DepthFrame]:
    """Captures of a still scene; colors differ by a gray level, as a sensor's would."""
    frames = list(scene(num_views=1).noisy_frames(count))
    return [replace(frame, colors=frame.colors ^ number) for number, frame in enumerate(frames)]  # type: ignore[operator]


def checked(frames: list[DepthFrame], limits: CaptureLimits | None = None) -> list[SampleReport]:
    return list(validate_source(Frames(frames), limits=limits))


def failed(report: SampleReport) -> set[str]:
    return {check.name for check in report.findings if check.verdict is Verdict.FAIL}


# -- series ------------------------------------------------------------------------------------------------------------


def test_captures_that_differ_pass_and_come_in_order_with_one_report_on_the_whole() -> None:
    reports = checked(shots())
    assert [report.sample_id for report in reports] == ["f0", "f1", "f2", WHOLE]
    assert all(report.verdict is Verdict.PASS for report in reports)
    assert [check.name for check in reports[-1].findings] == ["color_registration"]


def test_a_frozen_depth_image_fails_in_the_capture_that_repeats_and_names_the_first() -> None:
    frames = shots()
    frames.insert(2, replace(frames[2], depth=frames[1].depth))
    reports = checked(frames)
    assert [failed(report) for report in reports] == [set(), set(), {"repeated_depth"}, {"repeated_color"}, set()]
    check = next(one for one in reports[2].findings if one.name == "repeated_depth")
    assert "of 'f1', 1 capture before" in check.found


def test_an_image_that_comes_again_later_is_found_too() -> None:
    frames = [*shots(4), shots(4)[0]]
    assert failed(checked(frames)[4]) == {"repeated_depth", "repeated_color"}


def test_each_camera_is_compared_with_itself_alone() -> None:
    frame = scene(num_views=1).frame
    twins = DepthFrame(
        depth=frame.depth.repeat(2, 1, 1),
        camera=replace(frame.camera, intrinsics=frame.camera.intrinsics.repeat(2, 1, 1)),
    )
    assert verdicts(checked([twins])[0].findings, "repeated_depth") == [Verdict.PASS, Verdict.PASS]


def test_clocks_are_judged_where_there_are_any() -> None:
    def at(frame: DepthFrame, *times: float) -> DepthFrame:
        alone = replace(frame, colors=None, world_from_camera=None, frame_id=None)
        return replace(alone, provenance={"timestamps": list(times)})

    one = shots(6)
    reports = checked([at(frame, t) for frame, t in zip(one, (0.0, 0.03, 0.06, 0.20, 0.23, 0.22))])
    found = [verdicts(report.findings, "clock")[0] for report in reports[1:6]]
    assert found == [Verdict.PASS, Verdict.PASS, Verdict.WARN, Verdict.PASS, Verdict.FAIL]

    two = list(scene(num_views=2).noisy_frames(3))
    reports = checked([at(frame, t, t + apart) for frame, t, apart in zip(two, (0, 1, 2), (0.005, 0.02, 0.05))])
    assert [verdicts(report.findings, "sync")[0] for report in reports[:3]] == [
        Verdict.PASS,
        Verdict.WARN,
        Verdict.FAIL,
    ]
    assert "clock" not in {check.name for check in checked(shots(2))[1].findings}


def moving_camera(count: int = 4) -> list[DepthFrame]:
    eyes = [(0.3 * step - 0.4, -0.6, 0.6) for step in range(count)]
    poses = [look_at(eye) for eye in eyes]
    return [tabletop(2, noise="stereo", world_from_camera=pose[None], size=(240, 320)).frame for pose in poses]


def test_the_poses_of_a_moving_camera_are_judged_by_what_it_saw_before() -> None:
    frames = moving_camera()
    good = checked(frames)
    assert [verdicts(report.findings, "pose_direction") for report in good[1:]] == [[Verdict.PASS]] * 4
    inverted = [replace(f, world_from_camera=rigid.invert_rigid(f.world_from_camera)) for f in frames]  # type: ignore[arg-type]
    bad = checked(inverted)
    assert verdicts(bad[1].findings, "pose_direction") == [Verdict.WARN], "one pair may be an accident"
    assert all("pose_direction" in failed(report) for report in bad[2:])
    assert "pose_direction" not in {check.name for check in bad[0].findings}, "one view alone tells nothing"


@pytest.mark.parametrize(
    ("names", "ids"),
    [
        (("a", "b"), ["a/*", "b/*"]),
        (("run/a", "run/b"), ["run/a/*", "run/b/*"]),
        (("a",), ["*"]),
    ],
)
def test_the_reports_on_joined_recordings_are_told_apart(names, ids) -> None:
    source = JoinedSource({name: Frames(shots(2)) for name in names})
    reports = list(validate_source(source))
    assert [report.sample_id for report in reports if report.whole] == ids
    assert [report.sample_id for report in reports if not report.whole] == source.ids
    summary = Summary(reports)
    assert sum(summary.samples.values()) == len(source.ids)
    entry = summary.checks["color_registration (all captures)", 0]
    assert (sum(entry.counts.values()), entry.examples) == (len(ids), ids)


def test_the_reports_on_recordings_without_names_are_told_apart() -> None:
    class TwoRecordings(Frames):
        """Ids that share nothing."""

        def recordings(self) -> list[list[str]]:
            return [self.ids[:2], self.ids[2:]]

    reports = list(validate_source(TwoRecordings(shots(4))))
    assert [report.sample_id for report in reports if report.whole] == ["f0 to f1/*", "f2 to f3/*"]


def test_the_registration_over_all_captures_sees_what_single_ones_cannot() -> None:
    """Half of the rims in one capture, half in the other: each alone has too few points."""
    frame = tabletop(0, num_objects=1, noise="stereo", floor=False, size=(240, 320)).frame
    others = [tabletop(s, num_objects=1, noise="stereo", floor=False, size=(240, 320)).frame for s in range(1, 8)]
    reports = checked([frame, *others])
    alone = [verdicts(report.findings, "color_registration")[0] for report in reports[:-1]]
    assert alone.count(Verdict.UNKNOWN) >= len(alone) - 1
    assert verdicts(reports[-1].findings, "color_registration") == [Verdict.PASS]


def test_memory_does_not_grow_with_the_number_of_captures() -> None:
    def peak(count: int) -> int:
        source = SyntheticSource(num_scenes=count, size=(60, 80), num_objects=1)
        tracemalloc.start()
        for _ in validate_source(source):
            pass
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return size

    peak(2)  # imports and caches
    assert peak(12) < 1.2 * peak(4) + 50_000


@pytest.mark.parametrize("given", [None, "captures", torch.zeros(2)])
def test_what_is_no_source_and_no_frame_is_refused_with_what_to_do(given: object) -> None:
    with pytest.raises(DTypeError, match=r"validate_source: source must have ids and load\(id\), got .*open_source"):
        validate_source(given)  # type: ignore[arg-type]
    with pytest.raises(DTypeError, match=r"validate_frame: frame must be a DepthFrame, got .*source.load\(id\)"):
        validate_frame(given)  # type: ignore[arg-type]
    with pytest.raises(CaptureError, match=r"validate_source: .* has no samples"):
        validate_source(Frames([]))


# -- files -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    frames = [scene(seed, num_views=1).frame for seed in range(3)]
    return store(tmp_path_factory.mktemp("stored") / "capture", [replace(f, camera=frames[0].camera) for f in frames])


@pytest.fixture
def folder(stored: Path, tmp_path: Path) -> Path:
    """A capture of one's own, to spoil."""
    return shutil.copytree(stored, tmp_path / "capture")


def spoil_pose(root: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    file = root / "poses" / "f1.txt"
    np.savetxt(file, change(np.loadtxt(file)), fmt="%.17g")


def mirror(root: Path) -> None:
    spoil_pose(root, lambda pose: pose @ np.diag([1.0, 1.0, -1.0, 1.0]))


def transpose(root: Path) -> None:
    spoil_pose(root, lambda pose: pose.T)


def lose_tracking(root: Path) -> None:
    spoil_pose(root, lambda pose: np.full_like(pose, -np.inf))


def cut_off(root: Path) -> None:
    file = root / "depth" / "f1.png"
    file.write_bytes(file.read_bytes()[:1000])


def blank(root: Path) -> None:
    Image.fromarray(np.zeros((240, 320), np.uint16)).save(root / "depth" / "f1.png")


def far_too_large(root: Path) -> None:
    """Values that a factor of 1000 was applied to before they were stored; here: small ones read as millimetres."""
    Image.fromarray(np.full((240, 320), 3, np.uint16)).save(root / "depth" / "f1.png")


def another_size(root: Path) -> None:
    Image.fromarray(np.full((120, 160), 900, np.uint16)).save(root / "depth" / "f1.png")


@pytest.mark.parametrize(
    ("spoil", "name"),
    [
        (mirror, "pose"),
        (transpose, "pose"),
        (lose_tracking, "pose"),
        (cut_off, "readable"),
        (blank, "valid_fraction"),
        (far_too_large, "depth_unit"),
        (another_size, "intrinsics"),
    ],
)
def test_what_the_reader_refuses_is_a_named_failure_of_that_capture_and_the_others_go_on(
    folder: Path, spoil: Callable[[Path], None], name: str
) -> None:
    spoil(folder)
    reports = {report.sample_id: report for report in validate_source(open_source(folder))}
    assert failed(reports["f1"]) == {name}
    assert reports["f0"].verdict is not Verdict.FAIL
    assert reports["f2"].verdict is not Verdict.FAIL


@pytest.mark.parametrize(
    ("value", "verdict"), [(0.0, Verdict.PASS), (np.nan, Verdict.WARN), (np.inf, Verdict.WARN), (-1.0, Verdict.FAIL)]
)
def test_raw_values_are_counted_before_the_reader_cleans_them(folder: Path, value: float, verdict: Verdict) -> None:
    for file in sorted((folder / "depth").glob("*.png")):
        depth = read_depth(file, metres_per_unit=0.001).numpy()
        depth[:3, :5] = value
        np.save(file.with_suffix(".npy"), depth)
        file.unlink()
    facts = json.loads((folder / "intrinsics.json").read_text())
    (folder / "intrinsics.json").write_text(json.dumps(facts | {"metres_per_unit": 1.0}))
    report = next(validate_source(open_source(folder)))
    assert verdicts(report.findings, "raw_values") == [verdict]
    check = next(one for one in report.findings if one.name == "raw_values")
    assert check.value == pytest.approx(0.0 if value == 0 else 15 / (240 * 320))


def test_the_times_in_a_folder_are_judged(folder: Path) -> None:
    (folder / "timestamps.json").write_text(json.dumps({"f0": 10.0, "f1": 10.5, "f2": 10.4}))
    reports = {report.sample_id: report for report in validate_source(open_source(folder))}
    assert verdicts(reports["f1"].findings, "clock") == [Verdict.PASS]
    assert verdicts(reports["f2"].findings, "clock") == [Verdict.FAIL]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"f0": 1, "f1": 2}', "timestamp is missing for f2"),
        ('{"f0": 1, "f1": 2, "f2": 3, "f3": 4}', "timestamp but no depth for f3"),
        ('{"f0": 1, "f1": 2, "f2": "3"}', "seconds by name"),
        ('{"f0": 1, "f1": 2, "f2": 1e400}', "1e400 is not a finite number"),
        ("[1, 2, 3]", "must be a JSON object, got a list"),
        ("{", "not valid JSON"),
    ],
)
def test_times_that_cannot_be_are_refused(folder: Path, text: str, message: str) -> None:
    (folder / "timestamps.json").write_text(text)
    with pytest.raises(CaptureError, match=message):
        open_source(folder)


# -- clouds ------------------------------------------------------------------------------------------------------------


def test_an_organized_cloud_is_judged_on_coverage_and_range(test_data: Path) -> None:
    reports = list(validate_source(open_source(test_data / "pcd")))
    by_id = {report.sample_id: report for report in reports}
    mug = by_id["table_scene_mug_stereo_textured"]
    names = {"valid_fraction", "missing_region", "behind_camera", "depth_unit", "saturation"}
    assert {check.name for check in mug.findings} == names | {"at_origin", "extent"}
    assert mug.verdict is not Verdict.FAIL
    milk = by_id["milk_cartoon_all_small_clorox"]
    assert failed(milk) == {"behind_camera"}, "this file has z pointing backwards"


def judged_cloud(folder: Path, points: torch.Tensor) -> dict[str, Finding]:
    folder.mkdir()
    write_pcd(folder / "a.pcd", PointCloud(points=points, frame_id="base"))
    (report,) = validate_source(open_source(folder))
    return {one.name: one for one in report.findings}


@pytest.mark.parametrize(
    ("stray", "verdict"), [(2.0, Verdict.PASS), (20.0, Verdict.WARN), (1e12, Verdict.FAIL), (1e30, Verdict.FAIL)]
)
def test_one_point_that_alone_sets_the_extent_is_found(tmp_path: Path, stray: float, verdict: Verdict) -> None:
    points = torch.rand(5000, 3, generator=torch.Generator().manual_seed(0)) + 0.2
    points[17] = torch.tensor([stray, 0.5, 0.5])
    finding = judged_cloud(tmp_path / "clouds", points)["extent"]
    assert finding.verdict is verdict
    assert verdict is Verdict.PASS or f"({stray:.3g}, 0.5, 0.5); 1 lie beyond" in finding.found
    # Without it, or of identical points, nothing is found.
    assert judged_cloud(tmp_path / "rest", points[18:])["extent"].verdict is Verdict.PASS
    assert judged_cloud(tmp_path / "same", points[:1].expand(9, 3).contiguous())["extent"].verdict is Verdict.PASS


@pytest.mark.parametrize(("count", "verdict"), [(0, Verdict.PASS), (30, Verdict.WARN), (400, Verdict.FAIL)])
def test_points_at_the_origin_are_found(tmp_path: Path, count: int, verdict: Verdict) -> None:
    points = torch.rand(5000, 3, generator=torch.Generator().manual_seed(0)) + 0.2
    points[:count] = 0
    finding = judged_cloud(tmp_path / "clouds", points)["at_origin"]
    assert (finding.verdict, finding.value) == (verdict, count / 5000)


def test_an_unorganized_cloud_is_judged_on_range_alone(tmp_path: Path) -> None:
    points = torch.rand(5000, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([0.0, 0.0, 0.5])
    write_pcd(tmp_path / "good.pcd", PointCloud(points=points, frame_id="camera"))
    write_pcd(tmp_path / "tenfold.pcd", PointCloud(points=10 * points, frame_id="camera"))
    good, tenfold = validate_source(open_source(tmp_path))
    assert good.verdict is Verdict.PASS
    assert "valid_fraction" not in {check.name for check in good.findings}
    # Numbers without an image leave the unit open where none explains them better.
    assert tenfold.verdict is Verdict.WARN
    assert verdicts(tenfold.findings, "depth_unit") == [Verdict.WARN]
    _, stated = validate_source(open_source(tmp_path), limits=CaptureLimits(workspace=(0.2, 2.0)))
    assert "workspace_fraction" in failed(stated)


# -- real recordings ---------------------------------------------------------------------------------------------------


def test_a_real_hand_held_recording_has_right_poses_and_no_false_alarm_but_registration(test_data: Path) -> None:
    """Its depth is not registered to its color exactly, as its makers say; everything else is in order."""
    source = open_source(test_data / "seven_scenes", limit=12)
    for limits in (None, CaptureLimits(workspace=(0.3, 5.0))):
        for report in validate_source(source, limits=limits):
            assert failed(report) <= {"color_registration"}


def test_on_a_real_recording_inverted_poses_are_named(test_data: Path, tmp_path: Path) -> None:
    source = open_source(test_data / "seven_scenes", limit=3)
    for sample_id in source.ids:
        for file in source.files(sample_id).values():
            shutil.copy(file, tmp_path / file.name)
        pose = tmp_path / source.files(sample_id)["pose"].name
        np.savetxt(pose, np.linalg.inv(np.loadtxt(pose)), fmt="%.17g")
    shutil.copy(source.path / "camera-intrinsics.txt", tmp_path)
    reports = list(validate_source(open_source(tmp_path)))
    assert verdicts(reports[1].findings, "pose_direction") == [Verdict.WARN]
    for report in reports[2:]:
        check = next(one for one in report.findings if one.name == "pose_direction")
        assert check.verdict is Verdict.FAIL
        assert "camera_from_world" in check.advice


# -- reports -----------------------------------------------------------------------------------------------------------


def test_a_summary_counts_verdicts_and_names_the_first_of_the_worst() -> None:
    frames = shots()
    frames.append(replace(frames[0], depth=frames[0].depth * 10))
    reports = checked(frames)
    summary = Summary(reports)
    assert summary.verdict is Verdict.FAIL
    assert dict(summary.samples) == {Verdict.PASS: 3, Verdict.FAIL: 1}
    entry = summary.checks["depth_unit", 0]
    assert dict(entry.counts) == {Verdict.PASS: 3, Verdict.FAIL: 1}
    assert entry.examples == ["f3"]
    plain = json.loads(json.dumps(summary.to_json(), allow_nan=False))
    assert plain["verdict"] == "fail"
    assert plain["samples"] == {"pass": 3, "unknown": 0, "warn": 0, "fail": 1}
    assert json.loads(json.dumps(reports[3].to_json(), allow_nan=False))["verdict"] == "fail"


def refused(sample_id: str, found: str) -> SampleReport:
    return SampleReport(sample_id, (Finding(name="readable", verdict=Verdict.FAIL, found=found),))


def test_the_text_has_one_line_for_each_distinct_message_with_its_captures() -> None:
    cut = [refused(f"{n:04d}", f"read_depth: depth/{n:04d}.png: image file is truncated") for n in range(7)]
    empty = refused("0008", "read_depth: depth/0008.png: not an image")
    lines = [line for line in validation_text(Summary([*cut, empty])).splitlines() if line.startswith("FAIL readable")]
    assert lines == [
        "FAIL readable (0000, 0001, 0002, 0003, 0004, ...): read_depth: depth/0000.png: image file is truncated",
        "FAIL readable (0008): read_depth: depth/0008.png: not an image",
    ]


def test_a_text_that_holds_the_letters_of_a_sample_is_no_other_text() -> None:
    reports = [refused(sample_id, "holds 512 points, not 1024") for sample_id in ("1", "2", "5", "h", "points/1")]
    assert validation_text(Summary(reports)).count("FAIL readable") == 1
    reports = [refused(sample_id, f"{sample_id}: holds 512 points") for sample_id in ("1", "h", "scene/a", "scene/b-2")]
    assert validation_text(Summary(reports)).count("FAIL readable") == 1


def test_messages_kept_are_bounded_and_the_rest_is_counted() -> None:
    words = ["".join(letters) for letters in itertools.product("abcd", repeat=2)]
    checks = [Finding(name="readable", verdict=Verdict.FAIL, found=found) for found in words]
    text = validation_text(Summary(SampleReport("one", (check,)) for check in checks))
    assert text.count("FAIL readable") == 10
    assert "readable: other words in 6 captures more" in text


def test_nothing_to_judge_passes() -> None:
    assert Summary().verdict is Verdict.PASS
    assert SampleReport("empty", ()).verdict is Verdict.PASS
