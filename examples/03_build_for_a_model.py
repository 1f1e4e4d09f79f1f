"""Build a dataset for a model without a configuration: its preset has the steps, you say what it leaves open."""

import subprocess
import sys
import tempfile
from pathlib import Path

import pcdata
from pcdata.cli.main import main
from pcdata.io import CaptureCamera, write_capture_camera, write_color, write_depth, write_pose

# Captures with colors, whose poses lead to the robot's base.
folder = Path(tempfile.mkdtemp())
for name in ("depth", "color", "poses"):
    (folder / "captures" / name).mkdir(parents=True)
for number in range(4):
    frame = pcdata.synthetic.tabletop(seed=number, size=(120, 160)).frame
    write_depth(folder / f"captures/depth/{number}.png", frame.depth[0], metres_per_unit=0.001, round_to_unit=True)
    write_color(folder / f"captures/color/{number}.png", frame.colors[0])
    write_pose(folder / f"captures/poses/{number}.txt", frame.world_from_camera[0])
write_capture_camera(
    folder / "captures/intrinsics.json", CaptureCamera(camera=frame.camera, metres_per_unit=0.001, frame_id="base")
)
build = ["build", "--model", "dp3_real", "--source", str(folder / "captures"), "--out", str(folder / "dataset")]

# 1. What the model leaves open is never guessed: the error lists it with something to type, and the exit code is 2.
assert main(build) == 2
assert main([*build, "--set", "frame=base", "--set", "crop=((-0.4,-0.4,-0.02),(0.4,0.4,0.5))"]) == 0

# 2. The dataset remembers model and choices: check asks for no more, and load.py gives the model's tensors.
assert main(["check", str(folder / "dataset"), "--model", "dp3_real"]) == 0
subprocess.run([sys.executable, folder / "dataset" / "load.py"], check=True)

# 3. The same in a configuration, and in Python.
(folder / "build.yaml").write_text("model: {name: dp3_real, frame: base, crop: null, num_points: 512}\n")
assert pcdata.load_config(folder / "build.yaml").model.choices == {"frame": "base", "crop": None, "num_points": 512}
made = pcdata.preset("dp3_real", frame="base", crop=None)
print(made.collate([made.dataset(pcdata.open_source(folder / "captures"))[0]]))
