"""Simulated captures beside real ones: what differs, by how much, and the step that closes it."""

from dataclasses import replace

import pcdata
from pcdata.rng import generator_for
from pcdata.synthetic import SyntheticSource
from pcdata.transforms import Compose, RandomSensorNoise
from pcdata.validation import compare_sources


class Captures:
    """Anything with a name, ids and load is a source of captures."""

    def __init__(self, name, frames):
        self.name, self.frames = name, {frame.sample_id: frame for frame in frames}
        self.ids = list(self.frames)

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id: str) -> pcdata.DepthFrame:
        """Return one capture."""
        return self.frames[sample_id]


def rendered(seed, step=None):
    """Eight tables, through a step."""
    source = SyntheticSource(num_scenes=8, seed=seed, size=(120, 160))
    frames = [source.load(name) for name in source.ids]
    return [step(one, generator=generator_for(0, 0, one.sample_id)) for one in frames] if step else frames


# A simulator's depth is exact. The "real" camera has noise, and a calibration that is 20 mm off.
simulated = Captures("simulated", rendered(0))
real = rendered(100, RandomSensorNoise(sensor="realsense_d435"))
for place, frame in enumerate(real):
    poses = frame.world_from_camera.clone()
    poses[:, 2, 3] += 0.02
    real[place] = replace(frame, world_from_camera=poses)
result = compare_sources(simulated, Captures("real", real))
print(result.text())
assert {"noise", "holes", "offset"} <= {one.name for one in result.differences}

# The step that is named goes into the pipeline of the simulated captures; then the noise is no difference any more.
noise = Compose.from_config([next(one.step for one in result.differences if one.name == "noise")])
closer = compare_sources(Captures("simulated", rendered(0, noise)), Captures("real", real))
assert {one.name for one in closer.differences} == {"offset"}

# On the command line: pcdata compare simulated/ real/ --out compare.html
