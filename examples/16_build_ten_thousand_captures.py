"""Build in shards: they are kept when a build is stopped, and jobs share them; docs/builds.md."""

import tempfile
from pathlib import Path

import pcdata

config = pcdata.build.config_from_yaml("""
depth: [Deproject]
cloud: [FarthestPointSample: {num_points: 256, if_short: repeat}]
output: {format: packed, shard_size: 2}
""")
source = pcdata.synthetic.SyntheticSource(num_scenes=6, num_objects=1, size=(48, 64))
folder = Path(tempfile.mkdtemp())


# 1. A build that is stopped keeps what is finished, and the same call goes on.
def stop(done: int, total: int, sample_id: str) -> None:
    """Stop in the middle of the third shard."""
    if done == 5:
        raise KeyboardInterrupt


try:
    pcdata.build_dataset(config, source, folder / "set", progress=stop)
except KeyboardInterrupt:
    print(pcdata.build.outlook(config, source, folder / "set").num_finished, "of 3 shards are finished")
report = pcdata.build_dataset(config, source, folder / "set")
print(report.notes)
assert report.notes == ["2 of 3 shards were finished before"]

# 2. Jobs of a scheduler share the work; whichever ends last puts the dataset into place. Its bytes are the same.
jobs = [pcdata.build_dataset(config, source, folder / "shared", part=(k, 2)) for k in (1, 0)]
assert [job.is_complete for job in jobs] == [False, True]
one, two = ((folder / name / "dataset.json").read_bytes() for name in ("set", "shared"))
assert one == two
