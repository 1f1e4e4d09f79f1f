"""Do surfaces agree, and which one is off: alignment of clouds and of views."""

from pcdata.alignment.icp import icp_point_to_plane
from pcdata.alignment.plane_residuals import PlaneResiduals, point_to_plane_residuals
from pcdata.alignment.registration import CloudAlignment, align_clouds
from pcdata.alignment.view_agreement import view_agreement

__all__ = [
    "CloudAlignment",
    "PlaneResiduals",
    "align_clouds",
    "icp_point_to_plane",
    "point_to_plane_residuals",
    "view_agreement",
]
