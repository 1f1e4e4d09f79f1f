"""Captures whose folders, units and marks are not the usual ones: say so on the command line, in YAML or in Python."""

import json
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import pcdata
from pcdata.cli.main import main

# An export with depth/0.png .. depth/11.png where 65535 means "no reading", poses in pose/, and a thermal camera.
folder = Path(tempfile.mkdtemp())
for role in ("depth", "pose", "thermal"):
    (folder / "capture" / role).mkdir(parents=True)
intrinsics = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "metres_per_unit": 0.001}
(folder / "capture" / "intrinsics.json").write_text(json.dumps(intrinsics))
for number in range(12):
    depth = np.full((48, 64), 900 - number, np.uint16)
    depth[:4] = 65535
    Image.fromarray(depth).save(folder / "capture" / "depth" / f"{number}.png")
    (folder / "capture" / "pose" / f"{number}.txt").write_text("1 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1")

# A folder that looks like a part of the capture is never passed over: it is named, or left out with ROLE=.
options = ["--folder", "pose=pose", "--invalid-values", "65535", "--frame", "base"]
assert main(["inspect", str(folder / "capture")]) == 1
assert main(["inspect", str(folder / "capture"), *options]) == 0  # tells that thermal/ is not read

# The same in Python, and in the configuration of a build. Frames stand in the order of their numbers.
source = pcdata.open_source(
    folder / "capture", folders={"pose": "pose"}, invalid_values=[65535], frame_id="base", limit=11
)
assert source.ids[-2:] == ["9", "10"]
assert source.load("10").depth.max() < 1
(folder / "build.yaml").write_text(
    "source: {path: capture, folders: {pose: pose}, invalid_values: [65535], frame_id: base, temporal: 4}\n"
)
filtered = pcdata.load_config(folder / "build.yaml").source.open()
assert filtered.load("10").provenance["temporal_filter"]["frames"] == ["7", "8", "9", "10"]
