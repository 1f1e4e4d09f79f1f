"""The chain that built a dataset runs on a camera's stream: the same clouds, faults by name, latencies counted."""

import time
from dataclasses import replace

import numpy as np
import torch

import pcdata
from pcdata.live import LatestFrame, LivePipeline
from pcdata.synthetic import tabletop

chain = pcdata.Compose(
    [
        pcdata.MaskDepth(near=0.2, far=2.0),
        pcdata.RemoveFlyingPixels(),
        pcdata.Deproject(),
        pcdata.CropWorkspace(frame="camera", lower=(-0.4, -0.4, 0.2), upper=(0.4, 0.4, 1.5)),
        pcdata.RemovePlane(probability=0.9999),
        pcdata.FarthestPointSample(num_points=256),
    ]
)

# A camera at 60 Hz: millimetres and color, as a driver gives them. The fourth frame comes twice, the ninth is dark.
scene = tabletop(1, noise="stereo", num_views=1, size=(120, 160))
images = []
for number in range(12):
    frame = scene.render(seed_noise=number)
    images.append((np.rint(frame.depth[0].numpy() * 1000).astype(np.uint16), frame.colors[0].numpy()))
images[4] = images[3]
images[9] = (0 * images[9][0], images[9][1])
waiting = iter(images)


def read() -> dict[str, np.ndarray]:
    """Return the next frame once it is there; the last one is followed by StopIteration."""
    time.sleep(0.1)
    depth, colors = next(waiting)
    return {"frame": depth, "colors": colors}


def capture(depth: np.ndarray, colors: np.ndarray) -> pcdata.DepthFrame:
    """Return what the same arrays are offline."""
    return pcdata.DepthFrame.from_numpy(depth, scene.frame.camera, metres_per_unit=0.001, colors=colors)


live = LivePipeline(chain, like=capture(*images[0]), max_age=5.0)
answers = []
with LatestFrame.reading(read, timeout=5.0) as newest:
    for answer in live.follow(newest):
        answers.append(answer)
        print(answer.number, answer.fault or answer.cloud)

stats = live.stats()
print(stats)
assert stats.dropped + stats.frames == 12
if stats.dropped == 0:  # a machine that is very busy drops some
    assert [str(answer.fault) for answer in (answers[4], answers[9])] == ["frozen", "empty"]
    assert stats.faults == {"frozen": 1, "empty": 1}
    assert torch.equal(answers[5].cloud.points, chain(replace(capture(*images[5]))).points)
