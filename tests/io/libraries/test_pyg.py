"""Clouds go to PyTorch Geometric and come back as they were, through its own collate too."""

from __future__ import annotations

import warnings

import pytest
import torch

import pcdata
from pcdata import extras
from pcdata.errors import CaptureError, DTypeError, FrameError, MissingExtraError, NonFiniteError, ShapeError, UnitError
from pcdata.structures import PointCloud, SurfaceMesh
from tests.io.libraries.clouds import check_same, full_cloud


@pytest.fixture(scope="module")
def pyg():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what it imports
        return pytest.importorskip("torch_geometric")


def batch_of_three() -> PointCloud:
    return PointCloud.cat([full_cloud(5, 0), full_cloud(0, 1), full_cloud(7, 2)])


def test_without_it_the_command_that_installs_it_is_told(monkeypatch):
    monkeypatch.setattr(extras, "why_missing", lambda module: f"{module} is missing: pip install")
    for call in (lambda: pcdata.to_pyg(full_cloud()), lambda: pcdata.from_pyg(object())):
        with pytest.raises(MissingExtraError, match="torch_geometric is missing"):
            call()


def test_a_cloud_is_data_as_models_expect_it(pyg):
    cloud = full_cloud()
    data = pcdata.to_pyg(cloud)
    assert isinstance(data, pyg.data.Data)
    assert not isinstance(data, pyg.data.Batch)
    assert data.validate()
    assert data.num_nodes == 40
    assert data.pos.data_ptr() == cloud.points.data_ptr()
    assert torch.equal(data.x, cloud.colors)
    assert torch.equal(data.normal, cloud.normals)
    assert torch.equal(data.y, cloud.labels)
    assert torch.equal(data.confidence, cloud.extra["confidence"])
    assert torch.equal(data.joints, cloud.signals["joints"])
    assert (data.frame_id, data.unit, data.batch) == ("table", "m", None)


@pytest.mark.parametrize("num_points", [40, 1, 0])
def test_a_cloud_comes_back(pyg, num_points):
    cloud = full_cloud(num_points)
    check_same(pcdata.from_pyg(pcdata.to_pyg(cloud), like=cloud), cloud)
    alone = pcdata.from_pyg(pcdata.to_pyg(cloud), kinds={"approach": "direction"})
    assert alone.frame_id == "table"
    assert torch.equal(alone.labels, cloud.labels)
    if num_points > 1:
        assert torch.equal(alone.signals["joints"], cloud.signals["joints"])
        assert torch.equal(alone.colors, cloud.colors)


def test_a_batch_comes_back_and_parts_into_its_clouds(pyg):
    clouds = batch_of_three()
    batch = pcdata.to_pyg(clouds)
    assert isinstance(batch, pyg.data.Batch)
    assert batch.num_graphs == 3
    assert batch.ptr.tolist() == [0, 5, 5, 12]
    assert batch.batch.tolist() == [0] * 5 + [2] * 7
    assert batch.joints.shape == (3, 7)
    assert batch[2].pos.shape == (7, 3)
    check_same(pcdata.from_pyg(batch, like=clouds), clouds)
    alone = pcdata.from_pyg(batch)
    assert len(alone) == 3
    assert torch.equal(alone.ptr, clouds.ptr)
    assert torch.equal(alone.signals["joints"], clouds.signals["joints"])


def test_their_loader_and_transforms_work_on_it(pyg):
    loaded = next(iter(pyg.loader.DataLoader([pcdata.to_pyg(full_cloud(6, seed)) for seed in range(3)], batch_size=3)))
    check = pcdata.from_pyg(loaded)
    assert torch.equal(check.points, PointCloud.cat([full_cloud(6, seed) for seed in range(3)]).points)
    assert check.frame_id == "table"
    pooled = pyg.nn.global_max_pool(loaded.pos, loaded.batch)
    assert pooled.shape == (3, 3)
    sampled = pyg.transforms.FixedPoints(4, replace=False)(pcdata.to_pyg(full_cloud(6)))
    back = pcdata.from_pyg(sampled)
    assert back.num_points == 4
    assert "labels" in back.fields()


def test_features_are_chosen_and_found_again(pyg):
    cloud = full_cloud()
    data = pcdata.to_pyg(cloud, features=("colors", "feature", "score"))
    assert data.x.shape == (40, 8)
    assert data.x.dtype == torch.float32
    assert "feature" not in data
    back = pcdata.from_pyg(data, features=("colors", "feature", "score"), like=cloud)
    assert torch.equal(back.extra["feature"], cloud.extra["feature"])
    assert torch.allclose(back.extra["score"], cloud.extra["score"], atol=1e-7)
    assert back.extra["score"].dtype == torch.float64
    with pytest.raises(ShapeError, match="8 columns"):
        pcdata.from_pyg(data, features=("colors",))
    with pytest.raises(ShapeError, match="how many columns"):
        pcdata.from_pyg(data, features=("feature", "score"))
    assert "x" not in pcdata.from_pyg(data, features=()).fields()
    assert "x" in pcdata.from_pyg(data).fields()
    bare = PointCloud(points=cloud.points, frame_id="base")
    assert pcdata.to_pyg(bare).x is None
    assert pcdata.to_pyg(cloud, features=(), fields=()).keys() == pcdata.to_pyg(bare).keys()
    with pytest.raises(DTypeError, match="features: no field"):
        pcdata.to_pyg(bare, features=("normals",))
    with pytest.raises(DTypeError, match="not one text"):
        pcdata.to_pyg(cloud, features="colors")


def test_texts_of_each_cloud_are_signals(pyg):
    clouds = PointCloud.cat([full_cloud(3).with_signal("task", (text,), "text") for text in ("pick", "place")])
    batch = pcdata.to_pyg(clouds)
    assert batch.task == ["pick", "place"]
    assert pcdata.from_pyg(batch).signals["task"] == ("pick", "place")
    assert pcdata.from_pyg(pcdata.to_pyg(clouds[1])).signals["task"] == ("place",)
    check_same(pcdata.from_pyg(batch, like=clouds), clouds)


def test_gradients_pass(pyg):
    points = torch.rand(5, 3, requires_grad=True)
    data = pcdata.to_pyg(PointCloud(points=points, frame_id="base"))
    data.pos.sum().backward()
    assert torch.equal(points.grad, torch.ones(5, 3))


def test_a_mesh_has_faces(pyg):
    surface = SurfaceMesh(vertices=full_cloud(4), triangles=torch.tensor([[0, 1, 2], [0, 2, 3]]))
    data = pcdata.to_pyg(surface)
    assert data.face.tolist() == [[0, 0], [1, 2], [2, 3]]
    back = pcdata.from_pyg(data, like=surface)
    assert torch.equal(back.triangles, surface.triangles)
    check_same(back.vertices, surface.vertices)


def test_labels_of_whole_clouds_are_signals(pyg):
    data = pyg.data.Data(pos=torch.rand(8, 3), y=torch.tensor([3]))
    cloud = pcdata.from_pyg(data, frame_id="object")
    assert cloud.labels is None
    assert cloud.signals["y"].tolist() == [3]
    both = pyg.data.Batch.from_data_list([data, data])
    assert pcdata.from_pyg(both, frame_id="object").signals["y"].tolist() == [3, 3]


def test_what_cannot_be_a_cloud_is_refused(pyg):
    data = pyg.data.Data
    pos = torch.rand(6, 3)
    for wrong in (None, 3, pos, {"pos": pos}):
        with pytest.raises(DTypeError, match="takes torch_geometric"):
            pcdata.from_pyg(wrong)
    with pytest.raises(ShapeError, match="no pos"):
        pcdata.from_pyg(data(x=pos), frame_id="base")
    with pytest.raises(FrameError, match="which frame"):
        pcdata.from_pyg(data(pos=pos))
    with pytest.raises(FrameError, match="the data says 'table'"):
        pcdata.from_pyg(pcdata.to_pyg(full_cloud()), frame_id="base")
    with pytest.raises(CaptureError, match="no edges"):
        pcdata.from_pyg(data(pos=pos, edge_index=torch.zeros(2, 1, dtype=torch.long)), frame_id="base")
    with pytest.raises(NonFiniteError):
        pcdata.from_pyg(data(pos=pos / 0), frame_id="base")
    with pytest.raises(UnitError, match="metres_per_unit"):
        pcdata.from_pyg(data(pos=pos * 1e4), frame_id="base")
    with pytest.raises(ShapeError, match="row neither"):
        pcdata.from_pyg(data(pos=pos, other=torch.zeros(4)), frame_id="base")
    with pytest.raises(ShapeError, match="in order"):
        pcdata.from_pyg(data(pos=pos, batch=torch.tensor([1, 0, 0, 0, 1, 1])), frame_id="base")
    for wrong in (torch.full((6,), -1), torch.zeros(6), torch.full((6,), 10**12), torch.zeros(6, 1, dtype=torch.long)):
        with pytest.raises(ShapeError, match="batch must number"):
            pcdata.from_pyg(data(pos=pos, batch=wrong), frame_id="base")
    with pytest.raises(FrameError, match="must be a text"):
        pcdata.from_pyg(data(pos=pos, frame_id=3))
    with pytest.raises(DTypeError, match="features must be names"):
        pcdata.to_pyg(full_cloud(), features=3)
    mixed = pyg.data.Batch.from_data_list([data(pos=pos, frame_id="a"), data(pos=pos, frame_id="b")])
    with pytest.raises(FrameError, match="not of one frame_id"):
        pcdata.from_pyg(mixed)
    with pytest.raises(DTypeError, match="takes a PointCloud"):
        pcdata.to_pyg(pos)
    for name in ("x", "batch", "edge_index", "pos", "y"):
        with pytest.raises(DTypeError, match="something else called"):
            pcdata.to_pyg(full_cloud().with_extra(name, torch.zeros(40), "invariant"))
    with pytest.raises(DTypeError, match="would change the numbers"):
        pcdata.to_pyg(full_cloud().with_extra("class_index", torch.zeros(40), "invariant"))
