"""A dataset stored for training: one mapped file, batches read and augmented at once, the draws of single samples."""

import tempfile
from pathlib import Path

import torch
from torch.utils.data import DataLoader, RandomSampler

import pcdata
from pcdata.synthetic import TeleopSource

CONFIG = """
depth: [Deproject]
cloud: [ToFrame: {frame: base}, FarthestPointSample: {num_points: 64, if_short: repeat}]
augment: [RandomRotation: {degrees: 180}, RandomJitter: {sigma: 0.002}]
output: {format: packed}
"""

folder = Path(tempfile.mkdtemp()) / "set"
source = TeleopSource(num_episodes=2, num_views=1, size=(24, 32))
pcdata.build_dataset(pcdata.build.config_from_yaml(CONFIG), source, folder)
size = sum(path.stat().st_size for path in folder.glob("shards/*/clouds.packed"))
print(f"{size} bytes in one file a shard")

dataset = pcdata.CachedCloudDataset(folder, seed=0)
sampler = pcdata.CountedSampler(RandomSampler(dataset))
loader = DataLoader(dataset, batch_size=16, sampler=sampler, collate_fn=pcdata.collate_fixed)
for epoch in range(2):
    pcdata.set_epoch(loader, epoch)
    for batch in loader:
        assert batch.points.shape[1:] == (64, 3)

# A batch is what its samples are one by one, bit for bit: so workers, ranks and batch sizes change nothing.
batch = pcdata.collate_fixed(dataset.__getitems__([5, 0, 3]))
assert all(torch.equal(batch.points[row], dataset[index].points) for row, index in enumerate([5, 0, 3]))
print(batch)
