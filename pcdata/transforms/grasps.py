"""Grasps in any frame that a cloud knows, against the table that was found in it and against its points."""

from __future__ import annotations

import torch
from torch import Tensor

from pcdata.contracts.tensors import check_tensors
from pcdata.errors import UnitError
from pcdata.functional.grasps import GraspChecks, ParallelJaw, check_grasps
from pcdata.structures import METRE, PointCloud
from pcdata.transforms.found_planes import planes_in_cloud


def judge_grasps(
    cloud: PointCloud,
    grasps: Tensor,  # (G, 4, 4) float, frame_from_gripper, metres
    gripper: ParallelJaw,
    *,
    frame: str | None = None,
    openings: Tensor | None = None,  # (G,) float, metres
    tips: Tensor | None = None,  # (G,) float, metres
    b: int = 0,
) -> GraspChecks:
    """Check grasps of one cloud, wherever it was moved since: angle to its table, clearance, points hit and held.

    The table is the plane that RemovePlane found last; without one ``angle`` and ``clearance`` are None. Removed points
    are not hit, so ask for the clearance too: a grasp that digs into the table has a negative one.

    Args:
        cloud: the points, with what was found in them.
        grasps: rigid poses of the gripper in ``frame``.
        gripper: its dimensions, and the axes that these grasps are written in.
        frame: one that the cloud knows, such as "camera" though the cloud is in "base" or normalized; None = the
            coordinates that it has now.
        openings: between the fingers; None = the gripper's own.
        tips: from the origins of the grasps to the tips of the fingers; None = the gripper's own.
        b: which cloud of a batch.

    Raises:
        FrameError: the cloud does not know the frame.
        UnitError: no frame is given and the cloud is not in metres.
        PoseError, ConfigError, ShapeError, DTypeError, NonFiniteError: as :func:`pcdata.functional.check_grasps`.
    """
    given = {"grasps": grasps, "openings": openings, "tips": tips}
    check_tensors("judge_grasps", given, {"grasps": "G 4 4 : float", "openings": "G : float", "tips": "G : float"})
    own = cloud[b]
    if frame is not None:
        own = own.to_frame(frame)
    elif own.unit != METRE:
        raise UnitError(
            f"judge_grasps: the cloud is {own.unit}, but grippers have metres; name the frame of the grasps, such as "
            f"frame={own.source_frame!r}"
        )
    planes = planes_in_cloud(own)
    plane = planes[-1].to(own.device) if len(planes) else None
    if plane is not None and own.meta[0]["planes"][-1].get("faces") == "neither side" and own.num_points:
        height = own.points.double() @ plane[:3] + plane[3]
        plane = torch.where(height.median() < 0, -plane, plane)  # what is left stands on it
    each = {name: None if one is None else one.to(own.device) for name, one in given.items()}
    return check_grasps(own.points, **each, gripper=gripper, plane=plane)  # type: ignore[arg-type]
