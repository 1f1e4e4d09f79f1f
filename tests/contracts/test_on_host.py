"""What the host holds and knows of values on another device, and when it looks again."""

from __future__ import annotations

import gc
import pickle

import pytest
import torch

from pcdata.contracts import known, on_host
from pcdata.contracts.tensors import check_tensors
from pcdata.errors import CaptureError, NonFiniteError, ShapeError
from pcdata.functional.rows import ptr_after_mask
from pcdata.structures import DepthFrame, PointCloud
from pcdata.transforms import CropWorkspace, Deproject
from tests import pretend_device
from tests.factories import assert_same, cloud_in_base, tabletop_frame
from tests.pretend_device import device, host, pretend, watching

pytestmark = pytest.mark.skipif(not pretend_device.AVAILABLE, reason="this PyTorch has no devices written in Python")

SPECS = {"points": "N 3", "depth": "V H W : depth", "ptr": "ptr N B"}


def waits_of_check(**values: torch.Tensor) -> int:
    with watching() as watched:
        check_tensors("here", values, SPECS)
    return watched.waits.total()


def test_all_values_of_a_call_are_waited_for_once_and_never_again():
    values = {
        "points": pretend(torch.rand(9, 3)),
        "depth": pretend(torch.rand(1, 4, 5)),
        "ptr": pretend(torch.tensor([0, 4, 9])),
    }
    assert [waits_of_check(**values) for _ in range(3)] == [1, 0, 0]


@pytest.mark.parametrize(
    ("spoil", "error"),
    [
        (lambda points, depth, ptr: points.mul_(torch.inf), NonFiniteError),
        (lambda points, depth, ptr: depth.sub_(5.0), CaptureError),
        (lambda points, depth, ptr: ptr.copy_(torch.tensor([0, 7, 5])), ShapeError),
        (lambda points, depth, ptr: ptr.sub_(1), ShapeError),
        (lambda points, depth, ptr: points[3:].fill_(torch.nan), NonFiniteError),  # a view of the same memory
    ],
)
def test_what_was_changed_in_place_is_looked_at_again(spoil, error):
    values = {
        "points": pretend(torch.rand(9, 3) + 1),
        "depth": pretend(torch.rand(1, 4, 5)),
        "ptr": pretend(torch.tensor([0, 4, 9])),
    }
    check_tensors("here", values, SPECS)
    spoil(*values.values())
    for _ in range(2):  # a fault is never remembered as none
        with pytest.raises(error, match="here"):
            check_tensors("here", values, SPECS)


def test_other_values_of_the_same_tensor_are_read_anew():
    ptr = pretend(torch.tensor([0, 4, 9]))
    assert on_host.bounds_of(ptr) == [0, 4, 9]
    ptr[1] = 5
    assert on_host.bounds_of(ptr) == [0, 5, 9]


def test_host_memory_is_looked_at_in_every_call_as_numpy_changes_it_unseen():
    points = torch.rand(9, 3)
    check_tensors("here", {"points": points}, SPECS)
    points.numpy()[2] = float("nan")
    with pytest.raises(NonFiniteError):
        check_tensors("here", {"points": points}, SPECS)


def test_inference_tensors_do_not_tell_of_changes_so_nothing_is_known_of_them():
    with torch.inference_mode():
        points = pretend(torch.rand(9, 3)) + 1
        check_tensors("here", {"points": points}, SPECS)
        points.fill_(torch.nan)
        with pytest.raises(NonFiniteError):
            check_tensors("here", {"points": points}, SPECS)


def test_nothing_is_kept_of_tensors_that_are_gone():
    gc.collect()
    before = len(known._elsewhere)
    tensors = [pretend(torch.rand(9, 3)) for _ in range(20)]
    for tensor in tensors:
        check_tensors("here", {"points": tensor}, SPECS)
    assert len(known._elsewhere) >= before + 20
    del tensors, tensor
    gc.collect()
    assert len(known._elsewhere) <= before


def test_a_capture_that_the_host_has_checked_is_known_where_it_arrives():
    frame = tabletop_frame(2)
    there = frame.to(device())
    with watching() as watched:
        DepthFrame(depth=there.depth, camera=there.camera)
    assert not watched.waits
    with watching() as watched:  # depth that was made there is waited for once
        DepthFrame(depth=there.depth + 1, camera=there.camera)
    assert watched.waits.total() == 1


def test_far_depth_is_refused_there_too():
    there = tabletop_frame(1).to(device())
    with pytest.raises(Exception, match="multiply it by"):
        DepthFrame(depth=there.depth * 1000, camera=there.camera)


def test_picking_rows_waits_once_for_their_number():
    cloud = Deproject()(tabletop_frame(2).to(device()))
    keep = cloud.points[:, 2] > 0.5
    with watching() as watched:
        picked = cloud.select(keep, ptr_after_mask(keep, cloud.ptr))
        check_tensors("here", {"points": picked.points, "ptr": picked.ptr}, SPECS)
        assert on_host.counts_of(picked.ptr)
    assert watched.waits.total() == 1, watched.waits


def test_row_pointers_that_do_not_cut_the_picked_rows_are_refused_there_too():
    cloud = cloud_in_base((5, 4)).to(device())
    keep = pretend(torch.arange(9) % 2 == 0)
    with pytest.raises(ShapeError, match="must end at the number of rows, 5"):
        cloud.select(keep, pretend(torch.tensor([0, 2, 9])))
    with pytest.raises(ShapeError, match="must end at the number of rows, 3"):
        cloud.select(pretend(torch.tensor([0, 1, 5])), pretend(torch.tensor([0, 1, 2])))


def test_histories_are_those_of_the_processor_also_where_they_are_read_late_or_sent_away():
    steps = [Deproject(), CropWorkspace(frame="camera", lower=(-0.2, -0.2, 0.2), upper=(0.2, 0.2, 1.5))]
    here: DepthFrame | PointCloud = tabletop_frame(2)
    there = here.to(device())
    for step in steps:
        here, there = step(here), step(there)
    sent = pickle.loads(pickle.dumps(there.history))
    assert list(map(list, sent)) == list(map(list, here.history))
    assert there.history == here.history
    assert_same(here, there.to("cpu"))
    assert host(there.points).shape == here.points.shape
