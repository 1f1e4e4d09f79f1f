"""The table cut by its measured noise in whole rooms, with sensors of one and of five times a Kinect's noise."""

from __future__ import annotations

import json
import math
import warnings

import pytest
import torch

from pcdata.errors import NoPlaneError, TooFewPointsError
from pcdata.structures import PointCloud
from pcdata.synthetic import tabletop
from pcdata.transforms import (
    ClusterObjects,
    Deproject,
    RemovePlane,
    ToFrame,
    UnmeasuredTableWarning,
    planes_in_cloud,
)
from pcdata.validation import score_segmentation
from tests.rooms import seen_room, standing

KINECT = 0.0026
FIELDS = {"which": "supporting", "cut": "measured", "probability": 0.9999}
STEP = RemovePlane(**FIELDS)

TABLE = ((-0.5, -0.4, -0.002), (0.5, 0.4, 0.0))
THINGS = [standing(-0.2, 0.0, (0.12, 0.1, 0.15)), standing(0.15, 0.1, (0.1, 0.1, 0.2))]
FLOOR = ((-4.0, -2.0, -0.75), (4.0, 4.0, -0.7))
WALL = ((-3.0, 0.6, -0.7), (3.0, 0.7, 1.5))
SECOND_TABLE = ((-0.9, 0.45, -0.2), (0.9, 1.2, -0.198))

ROOMS = {
    "table alone": [TABLE],
    "floor and table": [TABLE, FLOOR],
    "a wall larger than the table": [TABLE, WALL],
    "two tables": [TABLE, SECOND_TABLE, FLOOR],
}
by_noise = pytest.mark.parametrize("noise", [0.0, KINECT, 5 * KINECT], ids=["exact", "kinect", "five kinects"])


def kept_of(cloud: PointCloud, left: PointCloud, label: int) -> float:
    """Share of the points of one box that are left."""
    return int((left.labels == label).sum()) / max(int((cloud.labels == label).sum()), 1)


@by_noise
@pytest.mark.parametrize("room", ROOMS)
def test_the_table_goes_and_all_that_stands_on_it_stays(room, noise):
    others = ROOMS[room]
    cloud = seen_room([*others, *THINGS], noise=noise)
    left = STEP(cloud)
    assert kept_of(cloud, left, 0) < 0.03
    for number in range(len(THINGS)):
        assert kept_of(cloud, left, len(others) + number) > 0.9
    for number in range(1, len(others)):
        assert kept_of(cloud, left, number) > 0.8  # noise hides the foot of a wall
    (plane,) = left.meta[0]["planes"]
    assert plane["cut"] == "measured"
    if noise:
        assert plane["disparity_noise"] == pytest.approx(noise, rel=0.15)


@by_noise
@pytest.mark.parametrize("room", ROOMS)
def test_things_are_told_apart_whatever_the_noise(room, noise):
    cloud = seen_room([*ROOMS[room], *THINGS], noise=noise)
    over = RemovePlane(**FIELDS, keep="over")(cloud)
    found = ClusterObjects(eps=0.04, min_points=10, min_size=60, keep="all", split_touching=True)(over)
    truth = torch.where(over.labels >= len(ROOMS[room]), over.labels, -1)
    scores = score_segmentation(found.labels, truth, ignore=(over.labels > 0) & (truth < 0))  # not the wall
    assert scores.found == 1
    assert scores.overlap_f > 0.95


@by_noise
@pytest.mark.parametrize("degrees", [-15, 10])
def test_a_tilted_table_is_a_table(degrees, noise):
    cloud = seen_room([TABLE, *THINGS], noise=noise, roll=math.radians(degrees))
    left = STEP(cloud)
    assert kept_of(cloud, left, 0) < 0.03
    assert min(kept_of(cloud, left, 1), kept_of(cloud, left, 2)) > 0.85


@by_noise
def test_an_empty_table_leaves_nothing_on_it(noise):
    cloud = seen_room([TABLE, WALL], noise=noise)
    left = STEP(cloud)
    assert kept_of(cloud, left, 0) == 0
    assert kept_of(cloud, left, 1) > 0.8
    with pytest.raises(TooFewPointsError, match="nothing is left"):
        STEP(seen_room([TABLE], noise=noise))


def test_where_there_is_no_plane_that_is_told():
    points = torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([0.0, 0.0, 0.5])
    few = PointCloud(points=points[:, :] * 10, frame_id="camera")
    with pytest.raises(NoPlaneError, match="is the table in the cloud"):
        STEP(few)
    with pytest.warns(UnmeasuredTableWarning):
        STEP(PointCloud(points=points, frame_id="camera"))


def test_clutter_through_the_plane_is_not_its_noise_and_where_it_is_most_nothing_is_cut():
    """Walls that cross a level with nothing on it, as in a shelf whose floor shines: no table was seen."""
    walls = [((x, -0.5, -0.4), (x + 0.02, 0.6, 0.3)) for x in torch.linspace(-0.6, 0.6, 7).tolist()]
    back = ((-0.7, 0.6, -0.4), (0.7, 0.62, 0.3))
    lip = ((-0.7, -0.06, -0.01), (0.7, 0.0, 0.0))  # the rim of the floor
    cloud = seen_room([lip, *walls, back], noise=KINECT, pitch=math.radians(15), distance=0.8)
    step = RemovePlane(
        which="supporting", cut="measured", up=(0, -1, -0.27), frame="camera", max_tilt=0.2, tilt_alarm=None
    )
    with pytest.warns(UnmeasuredTableWarning, match="none of it was removed"):
        left = step(cloud)
    (plane,) = left.meta[0]["planes"]
    assert plane["cut"] == "nothing"
    assert "noise" not in plane
    (entry,) = left.history[0][-1:]
    assert entry["params"]["believed"] is False
    assert json.loads(json.dumps(entry, allow_nan=False)) == entry
    assert torch.equal(left.points, cloud.points)
    off = cloud.points.double() @ torch.tensor(plane["normal"], dtype=torch.float64) + plane["offset"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnmeasuredTableWarning)
        above = RemovePlane(**step.to_config()["RemovePlane"] | {"keep": "above"})(cloud)
    assert above.num_points == int((off > -0.01).sum())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnmeasuredTableWarning)
        assert torch.equal(step.replay(cloud, [entry]).points, left.points)


@pytest.mark.parametrize("seed", range(4))
def test_a_far_floor_whose_noise_piles_up_is_not_what_things_stand_on(seed):
    """Stereo noise of the floor, 1.5 m away, is thicker than the slab: what juts out of it stands on nothing."""
    frame = next(iter(tabletop(seed, num_views=1, noise="stereo", size=(360, 480)).noisy_frames(1)))
    cloud = ToFrame(frame="base")(Deproject()(frame))
    (plane,) = planes_in_cloud(RemovePlane(which="supporting")(cloud))
    assert abs(float(plane[3])) < 0.002  # the table is z = 0, the floor 0.75 m below


def hollow(x: float, y: float, size: tuple[float, float, float], *, wall: float = 0.01, floor: float = 0.0) -> list:
    """A tray of four walls, and a floor of that height if any."""
    length, width, height = size
    walls = [
        standing(x - (length - wall) / 2, y, (wall, width, height)),
        standing(x + (length - wall) / 2, y, (wall, width, height)),
        standing(x, y - (width - wall) / 2, (length, wall, height)),
        standing(x, y + (width - wall) / 2, (length, wall, height)),
    ]
    return [*walls, standing(x, y, (length - 2 * wall, width - 2 * wall, floor))] if floor else walls


@pytest.mark.parametrize("keep", ["both", "above", "over"])
@pytest.mark.parametrize("noise", [0.0, KINECT])
def test_the_floor_of_a_tray_is_the_trays(noise, keep):
    """It is 2 mm high, and the noise of the table as much."""
    tray = hollow(0.0, 0.0, (0.3, 0.26, 0.05), floor=0.002)
    cloud = seen_room([TABLE, *tray, THINGS[1]], noise=noise)
    left = RemovePlane(**FIELDS, keep=keep)(cloud)
    assert kept_of(cloud, left, len(tray)) > 0.97
    assert kept_of(cloud, left, 0) < 0.03


def test_the_table_behind_a_handle_and_the_floor_of_a_bin_are_no_floors_of_trays():
    # A wicket before the camera: the table is seen through it, framed by its legs, its beam and a low sill before it.
    wicket = [
        standing(-0.06, -0.1, (0.015, 0.015, 0.16)),
        standing(0.06, -0.1, (0.015, 0.015, 0.16)),
        ((-0.07, -0.11, 0.145), (0.07, -0.09, 0.16)),
        ((-0.07, -0.11, 0.05), (0.07, -0.09, 0.065)),
    ]
    cloud = seen_room([TABLE, *wicket, THINGS[1]], noise=KINECT / 2)
    assert kept_of(cloud, STEP(cloud), 0) < 0.03
    # The walls of a bin enclose its floor, which a board parts.
    floor = ((-0.35, -0.3, -0.002), (0.35, 0.3, 0.0))
    bin_ = [floor, *hollow(0.0, 0.0, (0.7, 0.6, 0.1)), standing(0.0, 0.05, (0.7, 0.02, 0.06))]
    cloud = seen_room(bin_, noise=KINECT / 2)
    assert kept_of(cloud, STEP(cloud), 0) < 0.03
