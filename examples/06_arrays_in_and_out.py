"""Arrays in memory, as a driver or a simulator gives them: to a cloud a model takes, to files, and back."""

import tempfile
from pathlib import Path

import numpy as np

import pcdata
from pcdata.errors import UnitError

# A wall 0.8 m before the camera, in millimeters of 16 bits; color as RGB; where the camera stands in the robot's frame.
depth = np.full((120, 160), 800, np.uint16)
depth[40:80, 60:100] = 600  # a box before it
intrinsics = np.array([[150.0, 0.0, 80.0], [0.0, 150.0, 60.0], [0.0, 0.0, 1.0]])
colors = np.full((120, 160, 3), 128, np.uint8)
pose = np.array([[0, 0, 1, 0.3], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]], float)  # base_from_camera

try:
    pcdata.DepthFrame.from_numpy(depth, intrinsics)
except UnitError as error:
    print("whole numbers have no unit of their own:", error)

frame = pcdata.DepthFrame.from_numpy(
    depth, intrinsics, metres_per_unit=0.001, colors=colors, world_from_camera=pose, frame_id="base"
)
chain = pcdata.Compose([pcdata.Deproject(), pcdata.ToFrame(frame="base"), pcdata.FarthestPointSample(num_points=1024)])
cloud = chain(frame)
arrays = cloud.numpy()  # points (1024, 3) float32 in meters, colors, ...: they share the memory of the cloud
assert np.allclose(arrays["points"][:, 0].max(), 0.3 + 0.8, atol=1e-3)

folder = Path(tempfile.mkdtemp()) / "capture"
pcdata.write_capture(frame, folder)
source = pcdata.open_source(folder / "view0")
assert np.array_equal(source.load(source.ids[0]).depth, frame.depth)
print(cloud, source, sep="\n")
