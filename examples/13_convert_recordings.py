"""From recordings of a robot to what a policy trains from: inspect, convert, export; nothing is lost without a word."""

import tempfile
from pathlib import Path

import numpy as np

import pcdata
from pcdata.cli.main import main
from pcdata.exports import export_dataset
from pcdata.io import convert
from pcdata.synthetic import TeleopSource

folder = Path(tempfile.mkdtemp())
bags, lerobot, zarr = (str(folder / name) for name in ("bags", "lerobot", "dp3.zarr"))

# In place of your recordings: two simulated demonstrations, each a ROS 2 recording in MCAP.
source = TeleopSource(num_episodes=2, num_views=2, size=(24, 32))
print(convert(source, "mcap", bags).lost or "nothing was lost")

# What is in them, and what is missing; of what cannot be opened yet it names the option to add.
assert main(["inspect", bags]) == 0

# 1. A LeRobot dataset: depth, cameras, poses and signals as they were recorded; color=video would be smaller, and says
#    that it loses something.
assert main(["convert", bags, "--to", "lerobot", "--set", "color=image", "--out", lerobot]) == 0

# 2. What DP3's own loader opens: clouds are made on the way, as the model takes them.
choices = {"frame": "base", "crop": "none", "num_points": "64", "state": "joints,gripper"}
told = [word for name, value in choices.items() for word in ("--set", f"{name}={value}")]
assert main(["export", lerobot, "--to", "dp3", "--model", "dp3_sim", *told, "--out", zarr]) == 0

# The same as straight from the simulation, bit for bit.
made = pcdata.preset("dp3_sim", frame="base", crop=None, num_points=64)
export_dataset(made.dataset(source), "dp3", folder / "direct.zarr", frame="base", num_points=64, state="joints,gripper")
for array in ("point_cloud", "state", "action"):
    for chunk in Path(zarr, "data", array).iterdir():
        direct = np.frombuffer((folder / "direct.zarr" / "data" / array / chunk.name).read_bytes(), np.uint8)
        assert np.array_equal(np.frombuffer(chunk.read_bytes(), np.uint8), direct), (array, chunk.name)
