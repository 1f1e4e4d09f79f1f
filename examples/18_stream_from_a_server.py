"""A dataset on a server, gone through shard by shard: shuffled, shared by ranks, stopped and gone on with."""

import pcdata
from pcdata.synthetic import TeleopSource

CONFIG = """
depth: [Deproject]
cloud: [ToFrame: {frame: base}, FarthestPointSample: {num_points: 64, if_short: repeat}]
augment: [RandomRotation: {degrees: 180}, RandomJitter: {sigma: 0.002}]
output: {format: webdataset, shard_size: 8}
"""

url = "memory://demo/set"  # or s3://bucket/set, with: pip install "pcdata[remote]"
pcdata.build_dataset(pcdata.build.config_from_yaml(CONFIG), TeleopSource(num_episodes=2, num_views=1), url)

dataset = pcdata.CachedCloudDataset(url, seed=0)
stream = pcdata.StreamedCloudDataset(dataset, batch_size=8, shuffle_buffer=16)
print(stream)

# A DataLoader gets batch_size=None and collate_fn=pcdata.collate_fixed; here we go through it ourselves.
seen, state = [], None
for number, batch in enumerate(stream):
    seen += [cloud.meta[0]["sample_id"] for cloud in batch]
    if number == 1:
        state = stream.state_dict()  # what a checkpoint keeps
assert sorted(seen) == sorted(dataset.ids)

# Another process goes on after the second batch: the same samples, with the same draws.
resumed = pcdata.StreamedCloudDataset(pcdata.CachedCloudDataset(url, seed=0), batch_size=8, shuffle_buffer=16)
resumed.load_state_dict(state)
assert [cloud.meta[0]["sample_id"] for batch in resumed for cloud in batch] == seen[16:]

# Two ranks share the samples: none comes twice, none is lost.
parts = [pcdata.StreamedCloudDataset(dataset, batch_size=8, rank=rank, num_replicas=2) for rank in range(2)]
stream.set_epoch(1)
print([sum(len(batch) for batch in part) for part in parts], "of", len(dataset))
