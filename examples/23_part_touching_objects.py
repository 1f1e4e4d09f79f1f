"""Two boxes that touch come apart, and the labels are scored against the truth."""

import torch

import pcdata
from pcdata.validation import score_segmentation

# A camera looks straight down on a table from 0.9 m: a box, and one that is 18 mm higher and touches it. Metres.
depth = torch.full((240, 320), 0.9)
truth = torch.full((240, 320), -1)
for label, (rows, columns, height) in enumerate(
    [(slice(80, 160), slice(90, 160), 0.1), (slice(90, 150), slice(160, 230), 0.118)]
):
    depth[rows, columns] -= height
    truth[rows, columns] = label
noise = torch.randn(depth.shape, generator=torch.Generator().manual_seed(0)) * 0.001
camera = pcdata.Camera.pinhole(fx=300.0, fy=300.0, cx=159.5, cy=119.5, size=(240, 320))
frame = pcdata.DepthFrame.from_numpy((depth + noise).numpy(), camera)

# ClusterObjects needs the depth image, so it comes before anything that merges or thins out points.
plain = [pcdata.Deproject(), pcdata.RemovePlane(distance=0.01)]
together = pcdata.Compose([*plain, pcdata.ClusterObjects()])(frame)
apart = pcdata.Compose([*plain, pcdata.ClusterObjects(split_touching=True)])(frame)
print(f"clusters: {len(together.meta[0]['objects'])}, objects: {len(apart.meta[0]['objects'])}")
for cut in apart.meta[0]["touching"]["cuts"]:
    print(f"objects {cut['objects']} touch over {cut['pixels']} pixels and are two with {cut['strength']:.2f} of 1")

# The labels as an image, at the pixels that the points still know.
predicted = torch.full((240 * 320,), -1)
predicted[apart.source_index] = apart.labels
scores = score_segmentation(predicted.reshape(240, 320), truth)
print(f"overlap F {scores.overlap_f:.3f}, boundary F {scores.boundary_f:.3f}, found {scores.found:.0%}")
assert len(together.meta[0]["objects"]) == 1
assert scores.found == 1.0
