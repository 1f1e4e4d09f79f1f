"""The table of a scene, what stands on it, and which grasps keep clear of both."""

import math

import torch

import pcdata
from pcdata.functional import ParallelJaw
from pcdata.transforms import describe_objects, judge_grasps, label_image, plane_hulls_in_cloud, planes_in_cloud

# A camera looks straight down on a table from 0.9 m; two boxes, 10 and 6 cm high. Metres.
depth = torch.full((240, 320), 0.9)
depth[80:160, 90:130] -= 0.1
depth[100:140, 200:260] -= 0.06
depth += 0.001 * torch.randn(depth.shape, generator=torch.Generator().manual_seed(0))
camera = pcdata.Camera.pinhole(fx=300.0, fy=300.0, cx=159.5, cy=119.5, size=(240, 320))
frame = pcdata.DepthFrame.from_numpy(depth.numpy(), camera)

table = pcdata.RemovePlane(which="supporting", cut="measured", probability=0.9999)
cloud = pcdata.Compose([pcdata.Deproject(), table, pcdata.ClusterObjects()])(frame)
plane = cloud.meta[0]["planes"][-1]
print(f"table: {plane['inlier_share']:.0%} of the points, noise {1000 * plane['noise']:.1f} mm, {plane['faces']}")
print(f"hull of {len(plane_hulls_in_cloud(cloud)[0])} corners, plane {planes_in_cloud(cloud)[0].tolist()}")
for one in describe_objects(cloud):
    print(f"object {one.label}: {one.height:.3f} m high, box {[round(edge, 3) for edge in one.size.tolist()]} m")
print(f"pixels of objects: {int((label_image(cloud) >= 0).sum())}")

# Grasps of the camera's frame, approaching along z: above the first object, and too deep. Contact-GraspNet writes such.
gripper = ParallelJaw(
    opening=0.14, finger_length=0.05, finger_thickness=0.01, finger_width=0.02, palm_length=0.06, tip=0.1034
)
first = describe_objects(cloud)[0]
grasps = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)  # the camera looks down: its z is the approach
grasps[:, :2, 3] = first.centroid[:2]
grasps[:, 2, 3] = torch.tensor([0.84, 0.92]) - gripper.tip
cloud = pcdata.NormalizeUnitSphere()(cloud)  # wherever the cloud is now, the grasps are still the camera's
checks = judge_grasps(cloud, grasps, gripper, frame="camera")
for number in range(2):
    angle, clearance = math.degrees(checks.angle[number]), 1000 * float(checks.clearance[number])
    print(f"grasp {number}: {angle:.1f} degrees, {clearance:.0f} mm clear, hits {checks.hits[number]} points")
assert checks.clearance[0] > 0.05
assert checks.hits[0] == 0
assert checks.clearance[1] < 0
