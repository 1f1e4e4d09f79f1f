"""Hand clouds to Open3D and PyTorch Geometric and take them back; files for CloudCompare and MeshLab."""

import tempfile
from pathlib import Path

import torch

import pcdata
from pcdata.errors import MissingExtraError
from pcdata.synthetic import tabletop

frame = next(iter(tabletop(0, num_views=2, noise="stereo", size=(120, 160)).noisy_frames(1)))
chain = pcdata.Compose([pcdata.Deproject(), pcdata.ToFrame(frame="base"), pcdata.MergeViews()])
cloud = chain(frame)  # colors, labels, and in "view" the camera of each point

# Files: both programs show the labels in color, and what is read back is the same cloud.
folder = Path(tempfile.mkdtemp())
pcdata.write_ply(folder / "cloud.ply", cloud, scalar_names=True, quality="labels")
pcdata.write_pcd(folder / "cloud.pcd", cloud, encoding="binary_compressed")
back = pcdata.read_ply(folder / "cloud.ply")
assert torch.equal(back.labels, cloud.labels)
assert back.frame_id == "base"

try:
    geometry = pcdata.to_open3d(cloud)  # open3d.t: every field, in the same memory
    near = geometry.select_by_mask(geometry.point["positions"][:, 2] < 0.2)
    print("Open3D:", pcdata.from_open3d(near, like=cloud))  # the frame, and the way back to the source
    views = pcdata.to_open3d(frame, legacy=True, fields=("colors",))  # image, intrinsic, extrinsic of each
    print("Open3D:", views[0].intrinsic)
except MissingExtraError as error:
    print("left out:", error)

try:
    batch = pcdata.to_pyg(pcdata.PointCloud.cat([cloud, cloud]))  # pos, x, normal, y, batch, ptr
    print("PyTorch Geometric:", batch)
    assert torch.equal(pcdata.from_pyg(batch).labels[: cloud.num_points], cloud.labels)
except MissingExtraError as error:
    print("left out:", error)
