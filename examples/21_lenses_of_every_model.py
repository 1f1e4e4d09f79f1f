"""Cameras with a fisheye or RealSense's color lens: points, their pixels, and images without the lens."""

import torch

import pcdata
from pcdata.functional import deproject_depth, project_points

SIZE = (120, 160)
lens = {"lens": "fisheye", "distortion": [-0.005, 0.040, -0.037, 0.006]}
camera = pcdata.Camera.pinhole(fx=90.0, fy=90.0, cx=79.5, cy=59.5, size=SIZE, **lens)
print(camera)

# A wall one metre away, seen by a wide lens: its points lie on a plane.
frame = pcdata.DepthFrame(depth=torch.ones(1, *SIZE), camera=camera)
points, _, pixel_index = deproject_depth(frame.depth, camera.intrinsics, distortion=camera.distortion)
print("points on the wall:", len(points), "from", float(points[:, 0].min()), "to", float(points[:, 0].max()), "m")

# And they project to where they came from.
pixels, _ = project_points(points, intrinsics=camera.intrinsics, distortion=camera.distortion)
came_from = torch.stack([pixel_index % SIZE[1], pixel_index // SIZE[1]], dim=1)
print("largest error in pixels:", float((pixels - came_from).abs().max()))
assert float((pixels - came_from).abs().max()) < 1e-4

# What a pinhole would see, for formats that have no place for a lens.
straight = pcdata.Undistort(zoom=0.6)(frame)
assert straight.camera.distortion is None
print("readings before and after:", int((frame.depth > 0).sum()), int((straight.depth > 0).sum()))
