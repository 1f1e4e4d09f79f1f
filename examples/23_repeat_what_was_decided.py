"""The same decisions on other data of a capture: another mask, another camera's cloud, a sample that was stored."""

import dataclasses
import json

import torch

import pcdata
from pcdata.synthetic import tabletop

chain = pcdata.Compose(
    [
        pcdata.RandomTurnDepth(),
        pcdata.Deproject(),
        pcdata.ToFrame(frame="base"),
        pcdata.RemovePlane(distance=0.01),
        pcdata.RandomRotation(about="centroid"),
        pcdata.RandomSample(num_points=512),
    ]
)
scene = tabletop(seed=0, num_views=2, size=(60, 80)).frame
first = scene.view(0)
cloud = chain(first, generator=pcdata.rng.seeded(0))
history = json.loads(json.dumps(cloud.history[0]))  # as a stored sample gives it back

# On the capture that it was decided on, the same bits.
assert torch.equal(chain.replay(first, history).points, cloud.points)

# Another mask of the capture, here of what is labeled: the same pixels, turned the same way, in the same order.
masked = dataclasses.replace(first, labels=(first.labels > 0).long())
other = chain.replay(masked, history)
assert torch.equal(other.source_index, cloud.source_index)
print(f"{int(other.labels.sum())} of {other.num_points} points are on an object")

# The other camera saw other pixels: nothing can be said about those, and everything about planes and motions.
try:
    chain.replay(scene.view(1), history)
except pcdata.errors.ReplayError as error:
    print(str(error).splitlines()[0])
second = pcdata.Compose(list(chain.steps)[:-1]).replay(scene.view(1), history)
assert torch.allclose(second.frame_from_cloud("base"), cloud.frame_from_cloud("base"))
