"""Checks on one capture: each injected fault fails the check made for it, and a good capture passes all."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

import pcdata
from pcdata import validate_frame
from pcdata.errors import ConfigError
from pcdata.geometry import rigid
from pcdata.structures import Camera, DepthFrame
from pcdata.synthetic import Miscalibration, look_at, tabletop
from pcdata.validation import CaptureLimits
from pcdata.verdicts import Finding, Verdict
from tests.validation.captures import HEIGHT, SIZE, WIDTH, scene, verdicts


def failed(frame: DepthFrame, limits: CaptureLimits | None = None) -> set[str]:
    return {check.name for check in validate_frame(frame, limits=limits) if check.verdict is Verdict.FAIL}


def advice(frame: DepthFrame, name: str) -> str:
    return next(check.advice for check in validate_frame(frame) if check.name == name and check.advice)


@pytest.mark.parametrize(("seed", "num_views"), [(0, 1), (2, 1), (0, 3), (1, 3)])
def test_a_good_capture_passes_every_check(seed: int, num_views: int) -> None:
    """Where the objects are few, the place of a camera cannot always be measured; then it says so."""
    checks = validate_frame(scene(seed, num_views).frame)
    others = [check for check in checks if check.verdict is not Verdict.PASS]
    assert all(check.name == "view_pose" and check.found.startswith("not measurable") for check in others)
    assert all(bool(check.advice) == (check in others) for check in checks)
    per_view = [check for check in checks if check.view is not None and check.name != "view_pose"]
    assert len(per_view) == 13 * num_views


def test_every_check_has_a_number_and_a_threshold_and_goes_into_json() -> None:
    for check in validate_frame(scene(num_views=1).frame):
        plain = check.to_json()
        assert plain["verdict"] == "pass"
        assert isinstance(plain["value"], float)
        assert (plain["threshold"] is None) == check.name.startswith("plane_")  # these tell a number and judge nothing
        assert plain["threshold"] is None or isinstance(plain["threshold"], float)
        assert plain["found"]


def test_the_frame_is_not_changed() -> None:
    frame = scene(num_views=1).frame
    assert frame.colors is not None
    before = frame.depth.clone(), frame.colors.clone()
    validate_frame(frame)
    assert torch.equal(frame.depth, before[0])
    assert torch.equal(frame.colors, before[1])


@pytest.mark.parametrize(("factor", "cure"), [(10.0, "0.1"), (100.0, "0.01"), (0.1, "10"), (0.001, "1000")])
def test_a_wrong_unit_fails_and_the_right_one_is_told(factor: float, cure: str) -> None:
    frame = scene(num_views=1).frame
    wrong = replace(frame, depth=frame.depth * factor)
    assert "depth_unit" in failed(wrong)
    assert f"multiply depth by {cure} (" in advice(wrong, "depth_unit")


def test_a_far_scene_is_no_wrong_unit_once_the_workspace_is_given() -> None:
    frame = scene(num_views=1).frame
    far = replace(frame, depth=frame.depth * 5)
    assert "depth_unit" in failed(far)
    assert {"depth_unit", "workspace_fraction"} <= failed(far, CaptureLimits(workspace=(0.2, 2.0)))
    assert not {"depth_unit", "workspace_fraction"} & failed(far, CaptureLimits(workspace=(2.5, 30.0)))


@pytest.mark.parametrize("distance", [2.01, 2.5, 3.0])
def test_a_scene_at_the_end_of_the_workspace_is_no_wrong_unit(distance: float) -> None:
    """A deep one: part of it lies within 2 m, and ten times nearer not much more would lie beyond 0.2 m."""
    frame = scene(num_views=1).frame
    depth = distance * torch.linspace(0.3, 1.7, frame.depth.numel()).reshape(frame.depth.shape)
    spread = replace(frame, depth=depth, provenance={"metres_per_unit": 0.001})
    check = next(one for one in validate_frame(spread) if one.name == "depth_unit")
    assert check.verdict is Verdict.PASS
    assert check.value == pytest.approx(distance, abs=0.01)
    assert check.threshold == 2 * CaptureLimits().expected[1]


@pytest.mark.parametrize(
    ("rows", "columns", "place"),
    [
        (slice(0, HEIGHT // 2), slice(None), "at the top"),
        (slice(HEIGHT // 2, None), slice(None), "at the bottom"),
        (slice(None), slice(0, WIDTH // 2), "at the left"),
        (slice(None), slice(WIDTH // 2, None), "at the right"),
    ],
)
def test_a_missing_half_fails_and_is_located(rows: slice, columns: slice, place: str) -> None:
    depth = scene(num_views=1).frame.depth.clone()
    depth[:, rows, columns] = 0.0
    half = replace(scene(num_views=1).frame, depth=depth)
    assert "missing_region" in failed(half)
    assert any(place in check.found for check in validate_frame(half) if check.name == "missing_region")


def test_a_background_that_was_cut_away_warns_and_says_that_this_may_be_right() -> None:
    frame = scene(num_views=1).frame
    v, u = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    cut = replace(frame, depth=frame.depth * ((u - WIDTH / 2).abs() + (v - HEIGHT / 2).abs() < 0.35 * WIDTH))
    check = next(one for one in validate_frame(cut) if one.name == "missing_region")
    assert check.value is not None
    assert check.value > CaptureLimits().missing_region[1]
    assert check.verdict is Verdict.WARN
    assert "cut away on purpose" in check.advice


@pytest.mark.parametrize("size", [(120, 160), (480, 640)])
def test_coverage_scales_with_resolution(size: tuple[int, int]) -> None:
    """100,000 of 307,200 readings, scattered, are the least that does not fail, at any resolution."""
    frame = tabletop(0, size=size, floor=True).frame
    chance = torch.rand(size, generator=torch.Generator().manual_seed(0))
    for share, verdict in ((0.70, Verdict.PASS), (0.40, Verdict.WARN), (0.31, Verdict.FAIL)):
        thin = replace(frame, depth=torch.where(chance < share, frame.depth, 0.0))
        assert verdicts(validate_frame(thin), "valid_fraction") == [verdict]


@pytest.mark.parametrize(("x", "y"), [(3, 0), (-3, 0), (0, 3), (0, -3), (4, 4), (-6, 2)])
def test_shifted_color_fails_and_the_shift_is_told(x: int, y: int) -> None:
    frame = scene(num_views=1).frame
    assert frame.colors is not None
    checks = validate_frame(replace(frame, colors=frame.colors.roll((y, x), (1, 2))))
    assert verdicts(checks, "color_registration") == [Verdict.FAIL]
    check = next(one for one in checks if one.name == "color_registration")
    assert check.value == pytest.approx((x * x + y * y) ** 0.5, abs=1.25)


def test_registration_that_cannot_be_measured_is_unknown_with_the_reason() -> None:
    frame = scene(num_views=1).frame
    flat = replace(frame, depth=torch.full_like(frame.depth, 0.8))
    check = next(one for one in validate_frame(flat) if one.name == "color_registration")
    assert check.verdict is Verdict.UNKNOWN
    assert check.value is None
    assert check.found.startswith("not measurable: only 0 points")


def test_without_color_or_poses_their_checks_are_left_out() -> None:
    bare = replace(scene(0, 3).frame, colors=None, world_from_camera=None, frame_id=None)
    assert not {"color_registration", "pose", "pose_direction"} & {check.name for check in validate_frame(bare)}


@pytest.mark.parametrize("scale", [0.5, 0.75, 0.8, 1.25, 1.5])
def test_intrinsics_of_another_resolution_fail_and_its_size_is_told(scale: float) -> None:
    frame = scene(num_views=1).frame
    other = frame.camera.resized((round(HEIGHT * scale), round(WIDTH * scale)))
    wrong = replace(frame, camera=replace(other, size=frame.size))
    assert "principal_point" in failed(wrong)
    told = advice(wrong, "principal_point")
    width, height = (int(side) for side in told.split("about ")[1].split(":")[0].split("x"))
    assert width == pytest.approx(WIDTH * scale, rel=0.03)
    assert height == pytest.approx(HEIGHT * scale, rel=0.03)


def test_a_window_cut_from_an_image_may_have_its_principal_point_anywhere() -> None:
    frame = scene(num_views=1).frame
    window = DepthFrame(depth=frame.depth[:, :100, :100], camera=frame.camera.cropped(0, 0, (100, 100)))
    assert {check.name for check in validate_frame(window)} & {"principal_point", "field_of_view"} == set()


@pytest.mark.parametrize(("focal", "fails"), [(50.0, True), (307.0, False), (1500.0, True)])
def test_a_focal_length_that_no_depth_camera_has_fails(focal: float, fails: bool) -> None:
    camera = Camera.pinhole(fx=focal, fy=focal, cx=159.5, cy=119.5, size=SIZE)
    frame = replace(scene(num_views=1).frame, camera=camera)
    assert ("field_of_view" in failed(frame)) == fails


def test_pixels_that_are_not_square_warn_only() -> None:
    camera = Camera.pinhole(fx=307.0, fy=230.0, cx=159.5, cy=119.5, size=SIZE)
    checks = validate_frame(replace(scene(num_views=1).frame, camera=camera))
    assert verdicts(checks, "pixel_aspect") == [Verdict.WARN]


def test_a_camera_that_was_moved_by_10_mm_fails_and_is_named() -> None:
    moved = Miscalibration(translation=[0.0, 0.010, 0.0])
    frame = tabletop(1, num_objects=8, num_views=3, noise="stereo", size=SIZE, miscalibration=moved).frame
    checks = validate_frame(frame)
    assert verdicts(checks, "view_gap") == [Verdict.FAIL]
    assert [check.view for check in checks if check.name == "view_pose" and check.verdict is Verdict.FAIL] == [1]


def test_a_camera_off_along_what_is_determined_fails_though_sliding_is_not_determined() -> None:
    """A bare table fixes height and tilt alone; a camera that is 10 mm too high is wrong wherever it may have slid."""
    bare = tabletop(0, 0, 3, noise="stereo", floor=False, size=SIZE).frame
    depth = torch.zeros_like(bare.depth)
    depth[:, 80:160, 100:220] = bare.depth[:, 80:160, 100:220]  # without the table's edges, which show sides
    assert bare.world_from_camera is not None
    poses = bare.world_from_camera.clone()
    poses[1, 2, 3] += 0.010
    checks = validate_frame(replace(bare, depth=depth, colors=None, world_from_camera=poses))
    pose = next(one for one in checks if one.name == "view_pose" and one.view == 1)
    assert pose.verdict is Verdict.FAIL
    assert pose.value == pytest.approx(0.010, abs=0.001)
    level = [one for one in validate_frame(replace(bare, depth=depth, colors=None)) if one.name == "view_pose"]
    assert all(one.verdict is not Verdict.FAIL for one in level)


def test_of_views_that_fail_in_direction_no_gap_is_told() -> None:
    frame = scene(0, 3).frame
    assert frame.world_from_camera is not None
    inverted = replace(frame, world_from_camera=rigid.invert_rigid(frame.world_from_camera))
    assert "view_gap" not in {check.name for check in validate_frame(inverted)}


def transposed(poses: Tensor) -> Tensor:
    turned = poses.clone()
    turned[:, :3, :3] = poses[:, :3, :3].mT
    return turned


def opengl(poses: Tensor) -> Tensor:
    return poses @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


def in_millimetres(poses: Tensor) -> Tensor:
    longer = poses.clone()
    longer[:, :3, 3] *= 1000.0
    return longer


@pytest.mark.parametrize(
    ("mistake", "words", "seed"),
    [
        (rigid.invert_rigid, "camera_from_world", 0),
        (transposed, "transposed", 1),
        (opengl, "OpenGL", 0),
        (in_millimetres, "millimetres", 1),
    ],
)
def test_poses_of_another_convention_fail_and_it_is_named(mistake, words: str, seed: int) -> None:
    frame = scene(seed, 3).frame
    assert frame.world_from_camera is not None
    checks = validate_frame(replace(frame, world_from_camera=mistake(frame.world_from_camera)))
    (found,) = [check for check in checks if check.name == "pose_direction"]
    assert found.verdict is Verdict.FAIL
    assert words in found.advice


@pytest.mark.parametrize("percent", [2, 10])
def test_a_clipped_range_fails(percent: int) -> None:
    frame = scene(num_views=1).frame
    limit = frame.depth.flatten().sort().values[-round(percent / 100 * frame.depth.numel())]
    assert "saturation" in failed(replace(frame, depth=frame.depth.clamp_max(float(limit))))


def test_65535_read_as_depth_fails_and_the_cure_is_told() -> None:
    frame = scene(num_views=1).frame
    code = torch.tensor(65535 * 0.001)
    read = replace(
        frame, depth=torch.where(frame.depth > 1.2, code, frame.depth), provenance={"metres_per_unit": 0.001}
    )
    assert "saturation" in failed(read)
    assert "--invalid-values 65535" in advice(read, "saturation")
    assert '"invalid_values": [65535]' in advice(read, "saturation")


def test_a_workspace_that_is_none_is_refused() -> None:
    for given in ((2.0, 0.2), (0.0, 1.0), (0.5, float("inf")), (float("nan"), 1.0), (0.5,), (1.0, 2.0, 3.0), 2.0):
        with pytest.raises(ConfigError, match="workspace must be"):
            CaptureLimits(workspace=given)  # type: ignore[arg-type]


def test_only_a_workspace_that_is_stated_is_held_to_though_it_is_the_usual_one() -> None:
    frame = scene(num_views=1).frame
    assert not {one.name for one in validate_frame(frame)} & {"workspace_fraction"}
    usual = CaptureLimits().expected
    stated = CaptureLimits(workspace=usual)
    assert stated.workspace_is_stated
    assert not CaptureLimits().workspace_is_stated
    assert {one.name for one in validate_frame(frame, limits=stated)} & {"workspace_fraction"}
    assert not CaptureLimits.for_sensor("realsense_d435").workspace_is_stated


@pytest.mark.parametrize("away", [1.6, 2.0, 2.4])
def test_a_room_is_no_worse_than_a_table(away: float) -> None:
    """The floor with a table on it, from where somebody stands: most of it lies beyond 2 m; tenfold it is told."""
    pose = look_at((away, -1.2, 1.6))[None]
    frame = replace(
        tabletop(3, noise="stereo", size=SIZE, world_from_camera=pose).frame, provenance={"metres_per_unit": 0.001}
    )
    assert float(frame.depth[frame.depth > 0].median()) > 2.2
    unusual = {one.name for one in validate_frame(frame) if one.verdict in (Verdict.WARN, Verdict.FAIL)}
    assert unusual <= {"missing_region", "saturation"}, "the floor ends, and beyond 6 m nothing is read"
    tenfold = replace(frame, depth=10 * frame.depth, provenance={"metres_per_unit": 0.01})
    assert "depth_unit" in failed(tenfold)


def test_validation_is_public() -> None:
    assert pcdata.validate_frame is validate_frame
    assert isinstance(validate_frame(scene(num_views=1).frame)[0], Finding)
