"""A dataset split by episode, and described: what is held out stays held out."""

import tempfile
from pathlib import Path

import pcdata
from pcdata.build import write_card
from pcdata.synthetic import TeleopSource

folder = Path(tempfile.mkdtemp()) / "demonstrations"
source = TeleopSource(num_episodes=5, num_views=1, size=(12, 16))
config = pcdata.build.config_from_yaml("depth: [Deproject]\ncloud: [ToFrame: {frame: base}]")
pcdata.build_dataset(config, source, folder)

splits = pcdata.split_dataset(folder, {"train": None, "val": 1, "test": 1})  # whole episodes
train = pcdata.CachedCloudDataset(folder, split="train")
windows = pcdata.EpisodeWindows(train, num_obs=2, horizon=4)
print({name: len(splits.ids(name)) for name in splits.names}, windows)

# A later build moves nothing: the splits go with the dataset, and what is new is added.
pcdata.build_dataset(config, TeleopSource(num_episodes=6, num_views=1, size=(12, 16)), folder, overwrite=True)
later = pcdata.split_dataset(folder).part_of()
assert all(later[sample_id] == split for sample_id, split in splits.part_of().items())

missing = write_card(folder, {"license": "cc0-1.0", "sensor": "simulated"})
print((folder / "README.md").read_text().splitlines()[1], *missing, sep="\n")
