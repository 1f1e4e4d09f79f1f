"""Fuse the views of captures into one cloud, one mesh or one volume: pcdata fuse."""

import tempfile
from pathlib import Path

import pcdata
from pcdata.cli.main import main
from pcdata.io import CaptureCamera, write_capture_camera, write_color, write_depth, write_pose

# Four captures of one table, seen from different sides, with poses that lead to its frame.
folder = Path(tempfile.mkdtemp())
captures = folder / "captures"
for name in ("depth", "color", "poses"):
    (captures / name).mkdir(parents=True)
frame = pcdata.synthetic.tabletop(seed=1, num_views=4, size=(120, 160), noise="stereo").frame
for view in range(4):
    write_depth(captures / f"depth/{view}.png", frame.depth[view], metres_per_unit=0.001, round_to_unit=True)
    write_color(captures / f"color/{view}.png", frame.colors[view])
    write_pose(captures / f"poses/{view}.txt", frame.world_from_camera[view])
camera = pcdata.Camera(intrinsics=frame.camera.intrinsics[:1], size=frame.size)
write_capture_camera(captures / "intrinsics.json", CaptureCamera(camera=camera, metres_per_unit=0.001))

# Points with normals, colors and the number of views that saw them; triangles; or the field itself, to go on with.
fuse = ["fuse", str(captures), "--frame", "table", "--voxel-size", "0.005", "--out"]
assert main([*fuse, str(folder / "cloud.ply"), "--min-weight", "2"]) == 0
assert main([*fuse, str(folder / "mesh.ply"), "--mesh"]) == 0
assert main([*fuse, str(folder / "volume.npz")]) == 0

cloud = pcdata.read_ply(folder / "cloud.ply")
assert cloud.frame_id == "table"
assert cloud.extra["num_views"].min() >= 2
print(cloud, pcdata.read_volume(folder / "volume.npz"), sep="\n")
