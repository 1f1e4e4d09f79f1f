"""Leave bad captures out: a build quarantines those that fail, and whoever knows them lists them."""

import tempfile
from pathlib import Path

import torch

import pcdata
from pcdata.io import CaptureCamera, write_capture_camera, write_depth, write_pose

# Six frames of a table. The sensor gave nothing in frame 0, and tracking was lost in frame 4.
folder = Path(tempfile.mkdtemp())
capture = folder / "capture"
(capture / "depth").mkdir(parents=True)
(capture / "poses").mkdir()
frame = pcdata.synthetic.tabletop(seed=0, size=(120, 160)).frame
write_capture_camera(
    capture / "intrinsics.json", CaptureCamera(camera=frame.camera, metres_per_unit=0.001, frame_id="base")
)
for number in range(6):
    depth = frame.depth[0] if number else torch.zeros_like(frame.depth[0])
    write_depth(capture / "depth" / f"{number}.png", depth, metres_per_unit=0.001, round_to_unit=True)
    write_pose(capture / "poses" / f"{number}.txt", frame.world_from_camera[0])
(capture / "poses" / "4.txt").write_text("-inf " * 16)

# 1. Which ones are refused, and why; what is left loads throughout, in a Dataset too.
source = pcdata.open_source(capture)
refused = pcdata.refused_captures(source)
for sample_id, reason in refused.items():
    print(f"{sample_id}: {reason}")
assert source.without(refused).ids == ["1", "2", "3", "5"]

# 2. A build quarantines what fails, by itself. Captures that are known to be bad are listed instead: those it skips.
config = folder / "build.yaml"
config.write_text("source: {path: capture, skip: ['2']}\ndepth:\n- Deproject: {}\n")
settings = pcdata.load_config(config)
report = pcdata.build_dataset(settings, settings.source.open(), folder / "dataset", max_bad="50%")
print(f"built {len(report.samples)}, left out {report.skipped}, quarantined {report.quarantined}")
assert (list(report.skipped), list(report.quarantined)) == (["2"], ["0", "4"])
