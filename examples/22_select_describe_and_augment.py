"""Which points stay, what their neighborhoods are like, and what training may change: with limits that are held."""

import torch

import pcdata
from pcdata import functional as F

# A table of 1 m with a box on it, seen from above; three points are no numbers.
generator = torch.Generator().manual_seed(0)
table = torch.rand(3000, 3, generator=generator) * torch.tensor([1.0, 1.0, 0.0])
box = torch.rand(600, 3, generator=generator) * torch.tensor([0.1, 0.1, 0.0]) + torch.tensor([0.45, 0.45, 0.12])
points = torch.cat([table, box])
points[:3] = torch.nan
cloud = pcdata.PointCloud(points=points, frame_id="table", viewpoint=torch.tensor([[0.5, 0.5, 1.0]]))

steps = pcdata.Compose(
    [
        pcdata.DropNonFinite(max_drop=0.01),  # more would be a fault of the sensor: it raises
        pcdata.CropPolygon(frame="table", polygon=((0.2, 0.2), (0.8, 0.2), (0.5, 0.9)), low=-0.01, high=0.3),
        pcdata.VoxelDownsample(voxel_size=0.01, origin=(0.005, 0.005, 0.005)),
        pcdata.DescribeShape(features=("surface_variation",), radius=0.03, max_neighbors=30),
    ]
)
kept = steps(cloud)
print(f"{cloud.num_points} points, {kept.num_points} stay; on the box: {int((kept.points[:, 2] > 0.1).sum())}")
assert bool(torch.isfinite(kept.points).all())

# What training may change: another part is hidden every time, and each draw is written down.
hidden = pcdata.RandomOcclusion(low=0.2, high=0.3)(kept, generator=pcdata.rng.seeded(1))
print(f"{kept.num_points - hidden.num_points} points lie behind something that is not there")

# How far apart the two are, from one side alone: nothing of what is left was moved.
one_sided = F.chamfer_distance(hidden.points, hidden.ptr, kept.points, kept.ptr, sides="a_to_b")
assert float(one_sided.max()) == 0.0
