"""How the surfaces of a capture's views lie on each other, as numbers for every two views and as a number at points."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.alignment.view_alignment import measure_pairs, scene_middle
from pcdata.errors import PcdataError
from pcdata.functional.neighbors import knn
from pcdata.structures import DepthFrame, PointCloud
from pcdata.threads import torch_on_one_thread
from pcdata.validation.measures.view_surfaces import surfaces_of
from pcdata.validation.overlap import pairs_of
from pcdata.validation.overlap_result import OverlapLimits, PairOverlap
from pcdata.validation.view_names import view_names

GAP = "gap_between_cameras_mm"  # the field of points
_MAX_SAMPLES = 8000  # of each view
_REACH = 0.06  # metres between the surfaces of two views, as in verify_overlap
_NEAR = 0.012  # metres: a point has the gap of the nearest sample within it


@dataclass(frozen=True, eq=False)
class Overlap:
    """What two views or more say of one surface.

    Args:
        pairs: every two views.
        points: (M, 3) float64 in the frame of the poses, samples that another view saw too.
        gap: (M,) float64 metres, how far the other view's surface is from each.
    """

    pairs: tuple[PairOverlap, ...]
    points: Tensor
    gap: Tensor

    def shown_on(self, cloud: PointCloud, most_points: int) -> PointCloud:
        """Return every k-th point of a cloud in that frame, with the gap in mm; NaN where no other view saw it."""
        stride = max(1, -(-cloud.num_points // max(most_points, 1)))
        kept = torch.zeros(cloud.num_points, dtype=torch.bool, device=cloud.device)
        kept[::stride] = True
        counts = torch.stack([part.sum() for part in kept.split(cloud.counts.tolist())])
        some = cloud.select(kept, torch.nn.functional.pad(counts.cumsum(0), (1, 0)))
        values = torch.full((some.num_points,), torch.nan, dtype=torch.float32, device=cloud.device)
        if len(self.points):
            index, distance = knn(self.points.float().to(cloud.device), k=1, queries=some.points)
            near = distance[:, 0] < _NEAR
            values[near] = (1e3 * self.gap.to(cloud.device)[index[near, 0]]).float()
        return some.with_extra(GAP, values, "invariant")


@torch_on_one_thread()
def overlap_of(frame: DepthFrame) -> Overlap | None:
    """Compare the views of a capture as they are posed; None where it has one view or no poses."""
    if frame.num_views < 2 or frame.world_from_camera is None:
        return None
    try:
        surfaces, poses = surfaces_of("overlap_of", frame, max_samples=_MAX_SAMPLES)
    except PcdataError:
        return None
    fits = measure_pairs([surfaces], poses.double(), scene_middle([surfaces], poses.double()), _REACH)
    names = view_names(frame.provenance, frame.num_views)
    return Overlap(
        pairs=pairs_of(fits, names, OverlapLimits()),
        points=torch.cat([fit.points for fit in fits]),
        gap=torch.cat([fit.residual.abs() for fit in fits]),
    )
