"""One small synthetic capture set and its caches, built once per run."""

from __future__ import annotations

import multiprocessing
from pathlib import Path

import pytest

from pcdata.build import build_dataset, config_from_yaml
from pcdata.synthetic import SyntheticSource

# Workers that are forked from a server get their dataset pickled, as spawned ones do; only the server loads torch.
multiprocessing.set_forkserver_preload(["torch", "pcdata", "pcdata.build", "h5py"])

PIPELINE = """
depth: [MaskDepth: {near: 0.1, far: 3.0}, Deproject]
cloud:
  - ToFrame: {frame: base}
  - FarthestPointSample: {num_points: 64, if_short: repeat}
augment:
  - RandomRotation: {degrees: 90}
  - RandomJitter: {sigma: 0.002}
  - RandomPointDropout: {low: 0.1, high: 0.5}
"""


@pytest.fixture(scope="session")
def source() -> SyntheticSource:
    return SyntheticSource(num_scenes=8, num_objects=2, size=(24, 32))


@pytest.fixture(scope="session")
def config():
    return config_from_yaml(PIPELINE)


@pytest.fixture(scope="session")
def caches(source, tmp_path_factory) -> dict[str, Path]:
    """A built dataset per format."""
    root = tmp_path_factory.mktemp("caches")
    for form in ("hdf5", "npz", "packed", "pt", "webdataset"):
        build_dataset(config_from_yaml(f"{PIPELINE}output: {{format: {form}}}\n"), source, root / form)
    return {form: root / form for form in ("hdf5", "npz", "packed", "pt", "webdataset")}
