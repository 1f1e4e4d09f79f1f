"""Clouds, meshes and cameras go to Open3D and come back as they were; what has no place there is refused."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import torch

import pcdata
from pcdata import extras
from pcdata.errors import (
    CaptureError,
    ConfigError,
    DTypeError,
    FrameError,
    IntrinsicsError,
    MissingExtraError,
    NonFiniteError,
    PoseError,
    ShapeError,
    UnitError,
)
from pcdata.io import Open3DView, PosedCamera
from pcdata.structures import Camera, PointCloud, SurfaceMesh
from pcdata.synthetic import tabletop
from tests.io.libraries.clouds import check_same, full_cloud

CUBE = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])


@pytest.fixture
def o3d():
    return pytest.importorskip("open3d")


def mesh() -> SurfaceMesh:
    return SurfaceMesh(vertices=full_cloud(4), triangles=CUBE)


def test_without_open3d_the_command_that_installs_it_is_told(monkeypatch):
    monkeypatch.setattr(extras, "why_missing", lambda module: f"{module} is missing: pip install")
    for call in (lambda: pcdata.to_open3d(full_cloud()), lambda: pcdata.from_open3d(object())):
        with pytest.raises(MissingExtraError, match="open3d is missing"):
            call()


@pytest.mark.open3d
@pytest.mark.parametrize("num_points", [40, 1, 0])
def test_a_cloud_comes_back_with_every_field_frame_and_history(o3d, num_points):
    cloud = full_cloud(num_points)
    geometry = pcdata.to_open3d(cloud)
    assert isinstance(geometry, o3d.t.geometry.PointCloud)
    assert [*geometry.point["labels"].shape] == [num_points, 1]
    assert geometry.point["labels"].dtype == o3d.core.int64
    check_same(pcdata.from_open3d(geometry, like=cloud), cloud)


@pytest.mark.open3d
def test_without_the_cloud_the_fields_come_back_and_the_frame_is_asked(o3d):
    cloud = full_cloud()
    geometry = pcdata.to_open3d(cloud)
    with pytest.raises(FrameError, match="frame_id='base', or like="):
        pcdata.from_open3d(geometry)
    back = pcdata.from_open3d(geometry, frame_id="table", kinds={"approach": "direction"})
    for name in ("points", "colors", "normals", "labels", "source_index", "confidence", "view", "score", "feature"):
        assert torch.equal(back.fields()[name], cloud.fields()[name]), name
    assert back.kinds["confidence"] == "minimum"
    assert back.kinds["approach"] == "direction"
    with pytest.raises(FrameError, match="contradicts like="):
        pcdata.from_open3d(geometry, frame_id="base", like=cloud)
    with pytest.raises(DTypeError, match="kinds= names"):
        pcdata.from_open3d(geometry, frame_id="base", kinds={"nothing": "direction"})


@pytest.mark.open3d
def test_memory_is_shared_both_ways_unless_a_copy_is_asked_for(o3d):
    cloud = full_cloud()
    geometry = pcdata.to_open3d(cloud)
    for name, value in cloud.fields().items():
        shared = geometry.point["positions" if name == "points" else name].numpy()
        assert shared.ctypes.data == value.data_ptr(), name
    back = pcdata.from_open3d(geometry, like=cloud)
    assert all(value.data_ptr() == cloud.fields()[name].data_ptr() for name, value in back.fields().items())
    before = cloud.points.clone()
    pcdata.to_open3d(cloud, copy=True).translate([1.0, 0.0, 0.0])
    assert torch.equal(cloud.points, before)
    apart = pcdata.from_open3d(geometry, like=cloud, copy=True)
    assert apart.points.data_ptr() != cloud.points.data_ptr()
    pcdata.to_open3d(cloud).voxel_down_sample(0.1)
    assert torch.equal(cloud.points, before)
    pcdata.to_open3d(cloud).transform(np.diag([2.0, 2.0, 2.0, 1.0]))  # in place, as the docstring says
    assert torch.allclose(cloud.points, 2 * before)


@pytest.mark.open3d
def test_shared_memory_outlives_its_first_owner(o3d):
    wanted = full_cloud().points.clone()
    geometry = pcdata.to_open3d(full_cloud())
    gc.collect()
    back = pcdata.from_open3d(geometry, frame_id="table")
    del geometry
    gc.collect()
    torch.rand(1000, 3)
    assert torch.equal(back.points, wanted)


@pytest.mark.open3d
def test_a_batch_is_a_list_and_a_list_is_a_batch(o3d):
    batch = PointCloud.cat([full_cloud(5, 0), full_cloud(0, 1), full_cloud(7, 2)])
    several = pcdata.to_open3d(batch)
    assert [len(one.point["positions"]) for one in several] == [5, 0, 7]
    check_same(pcdata.from_open3d(several, like=batch), batch)
    assert len(pcdata.from_open3d(several, frame_id="table")) == 3
    assert [type(one) for one in pcdata.to_open3d([batch[0]])] == [o3d.t.geometry.PointCloud]
    with pytest.raises(DTypeError, match="like= has 3 clouds, but 2"):
        pcdata.from_open3d(several[:2], like=batch)
    with pytest.raises(DTypeError, match="list without items"):
        pcdata.from_open3d([], frame_id="base")


@pytest.mark.open3d
def test_rows_that_open3d_picks_bring_all_fields_along(o3d):
    cloud = full_cloud()
    picked = pcdata.to_open3d(cloud).select_by_index(o3d.core.Tensor([3, 5, 8]))
    back = pcdata.from_open3d(picked, like=cloud)
    wanted = cloud.select(torch.tensor([3, 5, 8]), torch.tensor([0, 3]))
    check_same(back, wanted)
    bare = pcdata.from_open3d(pcdata.to_open3d(cloud, fields=()), like=cloud)
    assert [*bare.fields()] == ["points"]


@pytest.mark.open3d
def test_the_older_classes_hold_points_colors_and_normals(o3d):
    cloud = full_cloud()
    with pytest.raises(DTypeError, match=r"no place for labels, confidence.*fields=\('colors', 'normals'\)"):
        pcdata.to_open3d(cloud, legacy=True)
    geometry = pcdata.to_open3d(cloud, legacy=True, fields=("colors", "normals"))
    assert isinstance(geometry, o3d.geometry.PointCloud)
    back = pcdata.from_open3d(geometry, like=cloud)
    assert back.points.dtype == torch.float32
    for name in ("points", "colors", "normals"):
        assert torch.equal(back.fields()[name], cloud.fields()[name]), name
    plain = PointCloud(points=cloud.points, frame_id="base", source_index=cloud.source_index)
    assert len(pcdata.to_open3d(plain, legacy=True).points) == 40
    empty = pcdata.to_open3d(PointCloud(points=torch.zeros(0, 3), frame_id="base"), legacy=True)
    assert pcdata.from_open3d(empty, frame_id="base").num_points == 0


@pytest.mark.open3d
def test_values_are_brought_to_what_a_cloud_holds(o3d):
    geometry = o3d.t.geometry.PointCloud()
    geometry.point["positions"] = o3d.core.Tensor(np.array([[500.0, 0, 1500], [0, 250, 1000]]))  # float64, millimetres
    geometry.point["colors"] = o3d.core.Tensor(np.array([[255, 0, 51], [0, 0, 0]], np.uint8))
    geometry.point["normals"] = o3d.core.Tensor(np.array([[0, 0, 2.0], [0, 0, -1]]))
    geometry.point["label"] = o3d.core.Tensor(np.array([[7], [2]], np.uint16))
    geometry.point["scalar value"] = o3d.core.Tensor(np.array([[0.5], [1.5]]))
    cloud = pcdata.from_open3d(geometry, frame_id="base", metres_per_unit=0.001)
    assert torch.equal(cloud.points, torch.tensor([[0.5, 0, 1.5], [0, 0.25, 1.0]]))
    assert torch.allclose(cloud.colors[0], torch.tensor([1.0, 0.0, 0.2]))
    assert cloud.normals.tolist() == [[0, 0, 1], [0, 0, -1]]
    assert cloud.labels.tolist() == [7, 2]
    assert cloud.extra["scalar_value"].tolist() == [0.5, 1.5]
    with pytest.raises(UnitError, match="metres_per_unit"):
        pcdata.from_open3d(geometry, frame_id="base")
    assert "label" in pcdata.from_open3d(geometry, frame_id="base", metres_per_unit=0.001, labels_from="").extra
    with pytest.raises(DTypeError, match="labels_from='lable' is not there; did you mean 'label'"):
        pcdata.from_open3d(geometry, frame_id="base", metres_per_unit=0.001, labels_from="lable")


@pytest.mark.open3d
def test_what_cannot_be_a_cloud_is_refused(o3d):
    geometry = o3d.geometry.PointCloud(o3d.utility.Vector3dVector([[0, 0, 1], [np.nan, 0, 0]]))
    with pytest.raises(NonFiniteError, match="1 of 2"):
        pcdata.from_open3d(geometry, frame_id="base")
    geometry = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.random.default_rng(0).random((9, 3))))
    geometry.estimate_covariances(o3d.geometry.KDTreeSearchParamKNN(4))
    with pytest.raises(CaptureError, match="covariances"):
        pcdata.from_open3d(geometry, frame_id="base")
    with pytest.raises(ShapeError, match="no positions"):
        pcdata.from_open3d(o3d.t.geometry.PointCloud(), frame_id="base")
    for wrong in (None, 3, "cloud", o3d.geometry.Image(np.zeros((2, 2), np.float32)), [1, 2]):
        with pytest.raises(DTypeError, match="from_open3d"):
            pcdata.from_open3d(wrong)
        with pytest.raises(DTypeError, match="to_open3d"):
            pcdata.to_open3d(wrong)
    with pytest.raises(DTypeError, match="no field 'color'; did you mean 'colors'"):
        pcdata.to_open3d(full_cloud(), fields=("color",))
    with pytest.raises(DTypeError, match="not one text"):
        pcdata.to_open3d(full_cloud(), fields="colors")
    for wrong in (3, [["colors"]], [3]):
        with pytest.raises(DTypeError, match="must be names of fields"):
            pcdata.to_open3d(full_cloud(), fields=wrong)
    geometry = pcdata.to_open3d(full_cloud())
    for wrong in (3, np.zeros(3), "base"):
        with pytest.raises(DTypeError, match="like= must be the cloud or mesh"):
            pcdata.from_open3d(geometry, like=wrong)
    with pytest.raises(ConfigError, match=r"one of position, direction, invariant, minimum, not 'banana'"):
        pcdata.from_open3d(geometry, frame_id="base", kinds={"score": "banana"})
    half = full_cloud().with_extra("half", torch.zeros(40, dtype=torch.float16), "invariant")
    with pytest.raises(DTypeError, match=r"half is torch\.float16"):
        pcdata.to_open3d(half)


@pytest.mark.open3d
@pytest.mark.parametrize("legacy", [False, True])
def test_a_mesh_comes_back(o3d, legacy):
    surface = mesh()
    fields = ("colors", "normals") if legacy else None
    geometry = pcdata.to_open3d(surface, legacy=legacy, fields=fields)
    assert isinstance(geometry, (o3d.geometry if legacy else o3d.t.geometry).TriangleMesh)
    geometry.compute_triangle_normals()
    back = pcdata.from_open3d(geometry, like=surface)
    assert torch.equal(back.triangles, CUBE)
    assert torch.equal(back.vertices.points, surface.vertices.points)
    if not legacy:
        check_same(back.vertices, surface.vertices)
    nothing = SurfaceMesh(vertices=full_cloud(0), triangles=torch.zeros(0, 3, dtype=torch.int64))
    empty = pcdata.from_open3d(pcdata.to_open3d(nothing), like=nothing)
    assert empty.triangles.shape == (0, 3)


@pytest.mark.open3d
def test_a_mesh_with_a_picture_on_it_is_refused(o3d):
    box = o3d.geometry.TriangleMesh.create_box(create_uv_map=True)
    for geometry in (box, o3d.t.geometry.TriangleMesh.from_legacy(box)):
        with pytest.raises(CaptureError, match="no place"):
            pcdata.from_open3d(geometry, frame_id="base")


@pytest.mark.open3d
def test_cameras_and_poses_come_back(o3d):
    frame = tabletop(0, num_views=2, size=(60, 80)).frame
    intrinsics = pcdata.to_open3d(frame.camera)
    back = pcdata.from_open3d(intrinsics)
    assert torch.equal(back.intrinsics, frame.camera.intrinsics)
    assert back.size == (60, 80)
    trajectory = o3d.camera.PinholeCameraTrajectory()
    parameters = []
    for view in pcdata.to_open3d(frame, legacy=True, fields=("colors",)):
        one = o3d.camera.PinholeCameraParameters()
        one.intrinsic, one.extrinsic = view.intrinsic, view.extrinsic
        parameters.append(one)
    trajectory.parameters = parameters
    found = pcdata.from_open3d(trajectory)
    assert isinstance(found, PosedCamera)
    assert torch.allclose(found.world_from_camera, frame.world_from_camera, atol=1e-12)
    assert found.camera.num_views == 2
    single = pcdata.from_open3d(parameters[0])
    assert torch.allclose(single.world_from_camera, frame.world_from_camera[:1], atol=1e-12)
    parameters[0].extrinsic = np.diag([1.0, 1, -1, 1])
    with pytest.raises(PoseError):
        pcdata.from_open3d(parameters[0])
    with pytest.raises(DTypeError, match="a camera has no frame_id"):
        pcdata.from_open3d(intrinsics[0], frame_id="base")


@pytest.mark.open3d
def test_a_lens_is_refused(o3d):
    k = torch.tensor([[[50.0, 0, 40], [0, 50, 30], [0, 0, 1]]], dtype=torch.float64)
    bent = Camera(intrinsics=k, size=(60, 80), distortion=torch.full((1, 5), 0.01, dtype=torch.float64))
    with pytest.raises(IntrinsicsError, match="Undistort"):
        pcdata.to_open3d(bent)
    k = k.clone()
    k[0, 0, 1] = 0.5
    with pytest.raises(IntrinsicsError, match="skewed"):
        pcdata.to_open3d(Camera(intrinsics=k, size=(60, 80)))


@pytest.mark.open3d
@pytest.mark.parametrize("legacy", [False, True])
def test_the_cloud_that_open3d_makes_of_a_view_is_ours(o3d, legacy):
    frame = tabletop(0, num_views=2, size=(60, 80)).frame
    views = pcdata.to_open3d(frame, legacy=legacy, fields=("colors",))
    assert len(views) == 2
    assert isinstance(views[0], Open3DView)
    for number, view in enumerate(views):
        if legacy:
            points = np.asarray(
                o3d.geometry.PointCloud.create_from_depth_image(
                    view.image.depth, view.intrinsic, view.extrinsic, depth_scale=1.0, depth_trunc=100.0
                ).points
            )
        else:
            points = (
                o3d.t.geometry.PointCloud.create_from_rgbd_image(
                    view.image, view.intrinsic, view.extrinsic, depth_scale=1.0, depth_max=100.0
                )
                .point["positions"]
                .numpy()
            )
        ours = pcdata.ToFrame(frame=frame.frame_id)(pcdata.Deproject()(frame))[number].points.numpy()
        assert points.shape == ours.shape
        if not legacy:  # threads write its rows in any order
            points = points[torch.cdist(torch.from_numpy(ours), torch.from_numpy(points)).argmin(dim=1)]
        assert np.abs(points - ours).max() < 1e-5
    if legacy:
        colored = o3d.geometry.PointCloud.create_from_rgbd_image(*views[0])
        assert len(colored.colors) == len(colored.points) > 0
    with pytest.raises(DTypeError, match="labels"):
        pcdata.to_open3d(frame)
