"""What a camera would see of a fused surface, from a place where none was."""

import torch

import pcdata
from pcdata.functional import deproject_ranges, depth_normals, render_ranges

camera = pcdata.Camera.pinhole(fx=120.0, fy=120.0, cx=79.5, cy=59.5, size=(120, 160))
depth = torch.full((1, 120, 160), 1.2)
depth[:, 30:90, 50:110] = 0.9  # a box before a wall
pose = torch.eye(4, dtype=torch.float64)[None]
frame = pcdata.DepthFrame(depth=depth, camera=camera, world_from_camera=pose, frame_id="base")

volume = pcdata.TSDFVolume(voxel_size=0.01)
volume.integrate(frame)
aside = pose.clone()
aside[0, 0, 3] = 0.15
seen = pcdata.render(volume, camera, aside)
print(
    "from the side:", int((seen.frame.depth > 0).sum()), "pixels, nearest", round(float(seen.frame.depth[0, 60, 60]), 3)
)

normals, curvature = depth_normals(depth, camera.intrinsics)
assert float(normals[0, 60, 80, 2]) < -0.999  # toward the camera
print("curvature on the wall:", float(curvature[0, 10, 10]))

# The range image of a lidar with 16 beams, and back.
cloud = pcdata.Deproject()(frame).to_frame("base").points[:, [2, 0, 1]]  # its x looks forward
image = render_ranges(cloud, size=(16, 720), elevations=(-0.26, 0.26))
points, _, _ = deproject_ranges(image.depth, elevations=(-0.26, 0.26))
print("lidar points:", len(points))
