"""Two clouds of one shape: the motion between them, and whether it can be trusted."""

import torch

from pcdata.alignment import align_clouds
from pcdata.functional import fit_paired_points
from pcdata.functional.rows import transform_points
from pcdata.geometry.rotations import rotation_from_euler

# Three faces of a box, and the same seen from a camera that stands 2 cm and 4 degrees off.
generator = torch.Generator().manual_seed(0)
target = torch.rand(3000, 3, generator=generator) * 0.4
target[torch.arange(3000), torch.arange(3000) % 3] = 0.0
truth = torch.eye(4, dtype=torch.float64)
truth[:3, :3] = rotation_from_euler(torch.tensor([0.05, -0.03, 0.04], dtype=torch.float64), "xyz")
truth[:3, 3] = torch.tensor([0.01, -0.015, 0.008])
source = transform_points(target, torch.tensor([0, 3000]), torch.linalg.inv(truth)[None])

found = align_clouds(source, target)
print("trusted:", found.is_trusted, "overlap:", round(found.overlap, 2), "basin in metres:", found.basin)
assert float((found.target_from_source - truth).abs().max()) < 1e-4

# A flat wall leaves three directions open: two slides and a turn. The result says so.
wall = torch.rand(2000, 3, generator=generator) * torch.tensor([0.4, 0.4, 0.0])
print("open on a wall:", len(align_clouds(wall, wall).found.unobservable), "directions")

# Where partners are known, one call fits thousands of clouds, with gradients.
ptr = torch.arange(0, 3001, 3000)
fitted = fit_paired_points(source, target, ptr)
print("of known partners, RMSE:", float(fitted.rmse[0]))
