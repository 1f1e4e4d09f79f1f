"""A camera's mount slips by 4 mm between captures: found, measured and dated from depth alone."""

from dataclasses import replace

import torch

import pcdata
from pcdata.synthetic import tabletop
from pcdata.validation import measure_drift

# A camera on a stand sees a table; before the capture "c12" somebody touches it.
pose = tabletop(0, size=(180, 240)).frame.world_from_camera
slipped = torch.eye(4, dtype=torch.float64)
slipped[0, 3] = 0.004
frames = []
for place in range(24):
    scene = tabletop(0, noise="stereo", size=(180, 240), world_from_camera=pose if place < 12 else pose @ slipped)
    frame = replace(scene.render(seed_noise=place), world_from_camera=None, frame_id=None, colors=None)
    frames.append(replace(frame, sample_id=f"c{place:02}"))


class Recording:
    """Anything with a name, ids and load is a source of captures."""

    name = "monday"
    ids = [frame.sample_id for frame in frames]

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id: str) -> pcdata.DepthFrame:
        """Return one capture."""
        return frames[self.ids.index(sample_id)]


result = measure_drift(Recording(), window=4, num_windows=6)
print(result.text())
(camera,) = result.cameras
for point in camera.points:
    moved = [round(1e3 * value, 1) for value in point.camera_shift]
    print(f"{point.first} to {point.last}: the camera is at {moved} mm, {point.verdict}")
assert camera.verdict == "fail"
assert abs(camera.points[-1].camera_shift[0] - 0.004) < 0.001

# On the command line, with a page of every camera's way: pcdata drift captures/ --out drift.html
