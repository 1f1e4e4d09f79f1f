"""A transform and a capture layout of your own, in a file that commands run because you name it: --import FILE.py."""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import pcdata
from pcdata.cli.main import main

folder = Path(tempfile.mkdtemp())
(folder / "mine.py").write_text('''
import numpy as np
import torch
from pcdata import Camera, DepthFrame, Transform, register_layout
from pcdata.io import Source

class EveryNth(Transform):
    """Keep every n-th point."""
    n: int
    def transform(self, cloud, params):
        index = torch.arange(0, cloud.num_points, self.n)
        return cloud.select(index, torch.tensor([0, len(index)]))

@register_layout
class Frames(Source):
    """NAME.npy with depth in metres."""
    kind, needs = "npy_frames", "NAME.npy: depth (H, W) in metres"
    def __init__(self, path, *, focal):
        self.focal = focal
        super().__init__(path, [file.stem for file in path.glob("*.npy")])
    @classmethod
    def recognizes(cls, path):
        return any(path.glob("*.npy"))
    def files(self, sample_id):
        return {"depth": self.path / f"{sample_id}.npy"}
    def _load(self, sample_id):
        depth = torch.from_numpy(np.load(self.files(sample_id)["depth"], allow_pickle=False))[None]
        height, width = depth.shape[1:]
        k = torch.tensor([[[self.focal, 0, width / 2], [0, self.focal, height / 2], [0, 0, 1]]]).double()
        return DepthFrame(depth=depth, camera=Camera(intrinsics=k, size=(height, width)), sample_id=sample_id)
''')
(folder / "captures").mkdir()
for number in range(4):
    np.save(folder / f"captures/{number}.npy", np.full((48, 64), 0.8 + number / 100, np.float32))
(folder / "build.yaml").write_text("depth: [Deproject]\ncloud: [EveryNth: {n: 3}]\nsource: {focal: 60.0}\n")

# 1. A configuration names transforms and layouts, never files: without --import both are unknown.
build = ["build", str(folder / "build.yaml"), "--source", str(folder / "captures"), "--out", str(folder / "dataset")]
assert main(build) == 2
own = ["--import", str(folder / "mine.py")]
assert main([*build, *own]) == 0

# 2. The dataset remembers name and hash of the file, not its place; load.py asks for it, and its workers run it too.
assert main(["inspect", str(folder / "dataset"), *own]) == 0
assert subprocess.run([sys.executable, folder / "dataset" / "load.py"], stderr=subprocess.DEVNULL).returncode == 2
subprocess.run([sys.executable, folder / "dataset" / "load.py", *own], check=True)

# 3. The same in Python.
pcdata.import_file(folder / "mine.py")
print(pcdata.CachedCloudDataset(folder / "dataset")[0])
