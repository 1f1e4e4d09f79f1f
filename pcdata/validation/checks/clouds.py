"""Checks on captures that are clouds already: what a depth image would tell, as far as a cloud still can."""

from __future__ import annotations

import torch

from pcdata.structures import PointCloud
from pcdata.validation.checks.coverage import coverage_checks
from pcdata.validation.checks.readings import reading_checks
from pcdata.validation.limits import CaptureLimits
from pcdata.verdicts import Finding, graded

_CAMERA = "camera"


def cloud_checks(cloud: PointCloud, limits: CaptureLimits) -> list[Finding]:
    """Judge a single cloud: coverage where its rows are the pixels of an image; unit, range and clipping always.

    Depth is z in a camera's frame, elsewhere the distance from the viewpoint.
    """
    checks = []
    size = cloud.meta[0].get("organised_size")
    if size is not None and cloud.source_index is not None:
        valid = torch.zeros(size[0] * size[1], dtype=torch.bool, device=cloud.device)
        valid[cloud.source_index] = True
        checks += coverage_checks(valid.view(size[0], size[1]), limits, may_be_cut=True)
    if cloud.frame_id.startswith(_CAMERA):
        depth = cloud.points[:, 2]
        checks.append(_behind(float((depth < 0).float().mean()) if len(depth) else 0.0))
        return checks + reading_checks(depth.abs(), limits)
    viewpoint = (
        torch.zeros(3, dtype=torch.float32, device=cloud.device) if cloud.viewpoint is None else cloud.viewpoint[0]
    )
    return checks + reading_checks((cloud.points - viewpoint).norm(dim=1), limits)


def _behind(fraction: float) -> Finding:
    return graded(
        "behind_camera",
        fraction,
        limits=(0.0, 0.01),
        found=f"{100 * fraction:.2g} % of the points have a negative z",
        advice="z points backwards (OpenGL axes), or the cloud is in another frame than the camera's: give frame_id",
    )
