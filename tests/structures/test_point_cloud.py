from __future__ import annotations

import copy
import dataclasses
import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata.errors import DeviceError, DTypeError, FrameError, PoseError, ShapeError, UnitError
from pcdata.functional.rows import ptr_from_counts
from pcdata.geometry import rigid
from pcdata.structures import METRE, NORMALIZED, Kind, PointCloud
from tests.factories import assert_same, base_from_camera, cloud_in_base, cloud_in_camera, differences, tree

ragged = st.lists(st.integers(0, 12), min_size=1, max_size=5)
few = settings(max_examples=30, deadline=None)


def affine(num_clouds: int, seed: int = 0, *, mirror: bool = False) -> torch.Tensor:
    """(B, 4, 4) rotations with different scales per axis and a shift."""
    factors = torch.tensor([-2.0 if mirror else 2.0, 0.5, 1.5], dtype=torch.float64)
    return base_from_camera(num_clouds, seed=seed) @ rigid.scaling(factors)


# -- construction --------------------------------------------------------------------------------------------------


def test_a_bare_cloud_is_a_batch_of_one_and_its_own_source():
    cloud = PointCloud(points=torch.zeros(5, 3), frame_id="base")
    assert cloud.ptr.tolist() == [0, 5]
    assert (cloud.num_clouds, len(cloud), cloud.num_points) == (1, 1, 5)
    assert torch.equal(cloud.source_from_cloud, torch.eye(4, dtype=torch.float64)[None])
    assert (cloud.source_frame, cloud.unit, cloud.meta, cloud.history) == ("base", METRE, ({},), ((),))
    assert set(cloud.fields()) == {"points"}


def test_a_cloud_cannot_be_changed():
    cloud = cloud_in_base()
    with pytest.raises(dataclasses.FrozenInstanceError):
        cloud.points = torch.zeros(1, 3)


def test_clouds_without_meta_do_not_share_one_dict():
    cloud = PointCloud(points=torch.zeros(2, 3), ptr=torch.tensor([0, 1, 2]), frame_id="base")
    assert cloud.meta[0] is not cloud.meta[1]


N, B = 4, 2
GOOD = {"points": torch.zeros(N, 3), "ptr": torch.tensor([0, 1, N]), "frame_id": "base"}


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ({"points": None}, DTypeError, "points must be a torch.Tensor"),
        ({"points": [[0.0, 0.0, 0.0]]}, DTypeError, "points must be a torch.Tensor"),
        ({"points": torch.zeros(N, 3).double()}, DTypeError, "points must be float32"),
        ({"points": torch.zeros(N, 2)}, ShapeError, r"points must be float32 \(N, 3\)"),
        ({"ptr": torch.tensor([0, N + 1])}, ShapeError, "must end at the number of rows"),
        ({"ptr": torch.tensor([0, 3, 2, N])}, ShapeError, "never decrease"),
        ({"ptr": torch.tensor([0])}, ShapeError, "row pointers"),
        ({"ptr": torch.tensor([0, N], dtype=torch.int32)}, DTypeError, "int64 row pointers"),
        ({"colors": torch.zeros(N, 3, dtype=torch.uint8)}, DTypeError, "colors must be float32"),
        ({"normals": torch.zeros(N + 1, 3)}, ShapeError, "normals has N=5 but points has N=4"),
        ({"labels": torch.zeros(N)}, DTypeError, "labels must be int64"),
        ({"viewpoint": torch.zeros(3, 3)}, ShapeError, "B"),
        ({"source_from_cloud": torch.eye(4).repeat(B, 1, 1)}, DTypeError, "source_from_cloud must be float64"),
        ({"frames": {"world": torch.eye(4).repeat(B, 1, 1)}}, DTypeError, r"frames\['world'\] must be float64"),
        ({"frames": {"world": torch.eye(4).double()[None]}}, ShapeError, r"frames\['world'\] has B=1"),
        ({"extra": {"mass": torch.zeros(N)}}, DTypeError, "every extra field needs a kind"),
        ({"kinds": {"mass": "invariant"}}, DTypeError, "every extra field needs a kind"),
        ({"extra": {"mass": [1.0] * N}, "kinds": {"mass": "invariant"}}, DTypeError, "must be a torch.Tensor"),
        ({"extra": {"mass": torch.zeros(N - 1)}, "kinds": {"mass": "invariant"}}, ShapeError, "has .3,. rows, not 4"),
        ({"extra": {"points": torch.zeros(N)}, "kinds": {"points": "invariant"}}, DTypeError, "cannot name"),
        ({"extra": {"a b": torch.zeros(N)}, "kinds": {"a b": "invariant"}}, DTypeError, "cannot name"),
        ({"extra": {"axis": torch.zeros(N)}, "kinds": {"axis": "direction"}}, ShapeError, r"must be float \(N, 3\)"),
        ({"extra": {"viewpoint": torch.zeros(N, 3)}, "kinds": {"viewpoint": "invariant"}}, DTypeError, "is a position"),
        ({"extra": {"mass": torch.zeros(N)}, "kinds": {"mass": "minimum"}}, DTypeError, "must be integers"),
        (
            {"extra": {"mass": torch.zeros(N, device="meta")}, "kinds": {"mass": "invariant"}},
            DeviceError,
            "is on meta but points is on cpu",
        ),
        ({"labels": torch.zeros(N, dtype=torch.int64, device="meta")}, DeviceError, "labels is on meta"),
        ({"meta": [{}]}, ShapeError, "meta needs an entry per cloud, 2, got 1"),
        ({"history": [[]] * 3}, ShapeError, "history needs an entry per cloud"),
        ({"unit": "mm"}, UnitError, "unit must be 'm' or 'normalized', got 'mm'"),
        ({"frame_id": ""}, FrameError, "frame_id must name"),
    ],
)
def test_what_does_not_fit_is_refused(fault, error, message):
    with pytest.raises(error, match=message):
        PointCloud(**{**GOOD, **fault})


# -- fields --------------------------------------------------------------------------------------------------------


def test_fields_are_replaced_added_and_dropped():
    cloud = cloud_in_base()
    labels = torch.zeros_like(cloud.labels)
    changed = cloud.with_fields(labels=labels, colors=None, weight=None)
    assert changed.labels is labels
    assert set(changed.fields()) == set(cloud.fields()) - {"colors", "weight"}
    assert "weight" not in changed.kinds
    added = changed.with_extra("mass", torch.ones(cloud.num_points), "invariant")
    assert added.kind("mass") is Kind.INVARIANT
    with pytest.raises(DTypeError, match="no field 'mass'; add it by with_extra"):
        cloud.with_fields(mass=torch.ones(cloud.num_points))
    with pytest.raises(DTypeError, match="points must be"):
        cloud.with_fields(points=None)


def test_meta_entries_are_merged_per_cloud():
    cloud = cloud_in_base((2, 3))
    found = cloud.with_meta([{"score": 1}, {"number": 9}])
    assert [entry.get("score") for entry in found.meta] == [1, None]
    assert [entry["number"] for entry in found.meta] == [0, 9]
    assert cloud.meta[1]["number"] == 1


def test_the_viewpoint_of_each_point_is_its_clouds_or_its_own():
    cloud = dataclasses.replace(cloud_in_base((2, 3)), viewpoint=torch.tensor([[1.0, 0, 0], [2.0, 0, 0]]))
    assert cloud.viewpoint_per_point()[:, 0].tolist() == [1, 1, 2, 2, 2]
    own = torch.rand(5, 3)
    assert torch.equal(cloud.with_extra("viewpoint", own, Kind.POSITION).viewpoint_per_point(), own)
    assert dataclasses.replace(cloud, viewpoint=None).viewpoint_per_point() is None


# -- select --------------------------------------------------------------------------------------------------------


@few
@given(ragged, st.integers(0, 99))
def test_select_takes_the_same_rows_of_every_field(counts, seed):
    cloud = cloud_in_base(counts)
    keep = torch.rand(cloud.num_points, generator=torch.Generator().manual_seed(seed)) < 0.5
    new_counts = [int(keep[a:b].sum()) for a, b in zip(cloud.ptr.tolist(), cloud.ptr.tolist()[1:])]
    chosen = cloud.select(keep, ptr_from_counts(new_counts))
    by_index = cloud.select(torch.nonzero(keep).squeeze(1), ptr_from_counts(new_counts))
    assert_same(chosen, by_index)
    assert chosen.counts.tolist() == new_counts
    for name, value in cloud.fields().items():
        assert torch.equal(chosen.fields()[name], value[keep])


def test_select_refuses_row_pointers_that_do_not_cut_the_result():
    cloud = cloud_in_base((3, 3))
    with pytest.raises(ShapeError, match="must end at the number of rows"):
        cloud.select(torch.tensor([0, 1]), torch.tensor([0, 1, 3]))
    with pytest.raises(ShapeError, match="ptr cuts 1 clouds out of 2"):
        cloud.select(torch.tensor([0, 1]), torch.tensor([0, 2]))


@pytest.mark.parametrize("end", [-3, 0, 4, 6, 10**15])
def test_select_refuses_row_pointers_that_end_elsewhere_than_a_mask(end):
    keep = torch.tensor([True] * 5 + [False])
    with pytest.raises(ShapeError, match="ptr must"):
        cloud_in_base([6]).select(keep, torch.tensor([0, end]))


@pytest.mark.parametrize("index", [torch.ones(6, 1).bool(), torch.zeros(2, 3).long(), torch.tensor(1)], ids=str)
def test_select_refuses_rows_in_other_than_one_dimension(index):
    with pytest.raises(ShapeError, match=r"index must be rows \(M,\) or a mask"):
        cloud_in_base([6]).select(index, torch.tensor([0, 6]))


# -- moving --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mirror", [False, True])
def test_a_motion_moves_positions_directions_and_nothing_else(mirror):
    cloud = cloud_in_camera((40, 0, 30))
    matrix = affine(3, mirror=mirror)
    moved = cloud.transformed(matrix, frame_id="elsewhere", unit=NORMALIZED)
    for b, (before, after) in enumerate(zip(cloud.unbatch(), moved.unbatch())):
        linear, shift = matrix[b, :3, :3], matrix[b, :3, 3]
        torch.testing.assert_close(after.points.double(), before.points.double() @ linear.T + shift, atol=1e-6, rtol=0)
        torch.testing.assert_close(after.viewpoint[0].double(), shift, atol=1e-6, rtol=0)
        # A tangent that was in the surface still is: normals stay perpendicular to the moved tangent.
        tangent = torch.linalg.cross(before.normals.double(), torch.ones(1, 3).double())
        across = ((tangent @ linear.T) * after.normals).sum(1)
        assert across.numel() == 0 or float(across.abs().max()) < 1e-5
        # And point to the same side.
        side = ((before.normals.double() @ linear.T) * after.normals).sum(1)
        assert bool((side > 0).all())
    assert torch.equal(moved.extra["anchor"], moved.points)
    assert torch.equal(moved.extra["heading"], moved.normals)
    for name in ("colors", "labels", "source_index", "row", "weight"):
        assert torch.equal(moved.fields()[name], cloud.fields()[name])
    assert (moved.frame_id, moved.unit, moved.source_frame) == ("elsewhere", NORMALIZED, "camera")


@few
@given(ragged, st.integers(0, 99), st.integers(1, 4))
def test_any_chain_of_motions_is_undone(counts, seed, length):
    cloud = cloud_in_camera(counts)
    moved = cloud
    for step in range(length):
        moved = moved.transformed(affine(len(counts), seed + step), frame_id=f"frame-{step}", unit=NORMALIZED)
    back = moved.in_source_frame()
    assert (back.frame_id, back.unit) == ("camera", METRE)
    torch.testing.assert_close(back.points, cloud.points, atol=3e-6, rtol=0)
    torch.testing.assert_close(back.normals, cloud.normals, atol=3e-6, rtol=0)
    identity = torch.eye(4, dtype=torch.float64).expand(len(counts), 4, 4)
    torch.testing.assert_close(back.source_from_cloud, identity, atol=1e-12, rtol=0)


def test_a_motion_needs_a_matrix_per_cloud():
    with pytest.raises(ShapeError, match=r"matrix must be \(3, 4, 4\)"):
        cloud_in_base().transformed(torch.eye(4, dtype=torch.float64)[None])


# -- batching ------------------------------------------------------------------------------------------------------


@few
@given(ragged, st.integers(0, 99))
def test_cat_undoes_unbatch(counts, seed):
    cloud = cloud_in_base(counts, seed=seed)
    singles = cloud.unbatch()
    assert [single.num_points for single in singles] == counts
    assert_same(PointCloud.cat(singles), cloud)
    for b, single in enumerate(PointCloud.cat(singles).unbatch()):
        assert_same(single, singles[b])


@few
@given(ragged, ragged)
def test_cat_joins_batches_in_order(first, second):
    joined = PointCloud.cat([cloud_in_base(first), cloud_in_base(second, seed=5)])
    assert joined.counts.tolist() == first + second
    assert_same(PointCloud.cat(joined.unbatch()), joined)


def test_unbatch_copies_nothing():
    cloud = cloud_in_base((3, 4))
    assert cloud.unbatch()[1].points.data_ptr() == cloud.points[3:].data_ptr()


def test_cat_keeps_the_frames_that_all_clouds_know():
    one, other = cloud_in_base((3,)), cloud_in_base((4,))
    lost = dataclasses.replace(other, frames={"base": other.frames["base"]})
    assert set(PointCloud.cat([one, lost]).frames) == {"base"}


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"frame_id": "camera"}, FrameError, "cloud 1 has frame_id 'camera' but cloud 0 has 'base'"),
        ({"source_frame": "world"}, FrameError, "source_frame"),
        ({"unit": NORMALIZED}, UnitError, "cloud 1 has unit 'normalized'"),
        ({"colors": None}, ShapeError, "carry different fields: {'colors'}"),
        ({"viewpoint": None}, ShapeError, "only one of cloud 0 and cloud 1 has a viewpoint"),
    ],
)
def test_cat_refuses_to_mix(change, error, message):
    cloud = cloud_in_base((5,))
    with pytest.raises(error, match=message):
        PointCloud.cat([cloud, dataclasses.replace(cloud, **change)])


def test_cat_refuses_kinds_that_differ_two_devices_and_nothing():
    cloud = cloud_in_base((5,))
    other = dataclasses.replace(cloud, kinds={**cloud.kinds, "anchor": Kind.DIRECTION})
    with pytest.raises(ShapeError, match="carry different fields: kinds"):
        PointCloud.cat([cloud, other])
    with pytest.raises(DeviceError, match="cloud 1 is on meta but cloud 0 is on cpu"):
        PointCloud.cat([cloud, cloud.to("meta")])
    with pytest.raises(ShapeError, match="at least one cloud"):
        PointCloud.cat([])


@few
@given(ragged, st.integers(0, 4))
def test_padding_is_marked_and_real_rows_are_kept(counts, more):
    cloud = cloud_in_base(counts)
    width = max(counts) + more
    padded = cloud.padded(width)
    assert padded.mask.shape == (len(counts), width)
    assert padded.mask.sum(1).tolist() == counts
    for name, value in cloud.fields().items():
        spread = getattr(padded, name) if hasattr(padded, name) else padded.extra[name]
        assert torch.equal(spread[padded.mask], value)
        filler = spread[~padded.mask]
        whole = value.dtype in (torch.int16, torch.int32, torch.int64)
        assert bool((filler == (-1 if whole else 0)).all())
    for b, single in enumerate(cloud.unbatch()):
        assert torch.equal(padded.points[b, : counts[b]], single.points)


def test_padding_defaults_to_the_longest_and_refuses_less():
    cloud = cloud_in_base((3, 7))
    assert cloud.padded().points.shape == (2, 7, 3)
    assert cloud.padded().frame_id == "base"
    with pytest.raises(ShapeError, match="a cloud has 7 points, more than num_points=6"):
        cloud.padded(6)


# -- devices and processes -----------------------------------------------------------------------------------------


def test_to_moves_every_tensor():
    cloud = cloud_in_base()
    moved = cloud.to("meta")
    tensors = [*moved.fields().values(), moved.ptr, moved.viewpoint, moved.source_from_cloud, *moved.frames.values()]
    assert {tensor.device.type for tensor in tensors} == {"meta"}
    assert_same(cloud.to("cpu"), cloud)
    assert cloud.padded().to("meta").mask.device.type == "meta"


@pytest.mark.parametrize("twin", [lambda cloud: pickle.loads(pickle.dumps(cloud)), copy.deepcopy])
def test_copies_hold_the_same(twin):
    cloud = cloud_in_base((3, 0, 4))
    assert_same(twin(cloud), cloud)
    assert_same(twin(cloud.padded()), cloud.padded())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="page-locked memory needs a CUDA device")
def test_pinned_clouds_hold_the_same():
    cloud = cloud_in_base()
    assert cloud.pin_memory().points.is_pinned()
    assert cloud.padded().pin_memory().mask.is_pinned()
    assert_same(cloud.pin_memory(), cloud)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device to compare the CPU with")
def test_motions_and_selections_agree_on_cuda():
    cloud, matrix = cloud_in_base(), affine(3)
    on_cpu, on_gpu = cloud.transformed(matrix), cloud.to("cuda").transformed(matrix)
    assert not differences(tree(on_cpu), tree(on_gpu.to("cpu")), tolerance=1e-6)
    assert_same(cloud.padded(), cloud.to("cuda").padded().to("cpu"))


def test_the_repr_says_how_many_points_where_and_what():
    assert repr(cloud_in_base((3,))).startswith("PointCloud(3 points in 'base' [m]: colors, normals")
    assert repr(cloud_in_base((3, 0, 9))).startswith("PointCloud(3 clouds of 0-9 in 'base' [m]")
    assert repr(cloud_in_base((3, 9)).padded()) == "PaddedClouds(2 x 9 in 'base' [m])"


SPOILT = pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda matrix: matrix.mT, r"matrix 1 must have the last row 0 0 0 1, got .*made for row vectors"),
        (lambda matrix: matrix + torch.eye(4).double()[3] * 0.5, "matrix 0 must have the last row 0 0 0 1"),
        (lambda matrix: matrix * torch.nan, "matrix 0 has NaN or infinite values"),
        (lambda matrix: matrix + torch.full((4, 4), torch.inf).double().triu(3), "matrix 0 has NaN or infinite values"),
        (lambda matrix: matrix * torch.tensor([1.0, 1, 0, 1]).double(), "matrix 0 is singular"),
    ],
    ids=["transposed", "projective", "nan", "infinite", "flat"],
)


@SPOILT
@pytest.mark.parametrize("num_clouds", [2, 40])
def test_a_matrix_that_is_not_affine_moves_no_cloud(spoil, words, num_clouds):
    cloud = cloud_in_base((5, 4) * (num_clouds // 2))
    matrix = torch.eye(4, dtype=torch.float64).repeat(num_clouds, 1, 1)
    matrix[1, :3, 3] = torch.tensor([0.1, 0.2, 0.3])
    with pytest.raises(PoseError, match=rf"PointCloud.transformed: {words}"):
        cloud.transformed(spoil(matrix))
    with pytest.raises(PoseError, match=rf"PointCloud.with_facts_moved: {words}"):
        cloud.with_facts_moved(torch.stack([matrix, spoil(matrix)]))
    cloud = dataclasses.replace(cloud, recorded_signals={})
    with pytest.raises(PoseError, match=rf"PointCloud: source_from_cloud: {words}"):
        dataclasses.replace(cloud, source_from_cloud=spoil(matrix))
    with pytest.raises(PoseError, match=rf"PointCloud: frames\['table'\]: {words}"):
        dataclasses.replace(cloud, frames={"table": spoil(matrix)})


def test_motions_of_other_clouds_move_none():
    with pytest.raises(ShapeError, match=r"PointCloud.with_facts_moved: matrix must be \(2, 4, 4\)"):
        cloud_in_base((5, 4)).with_facts_moved(torch.eye(4, dtype=torch.float64)[None, None])
