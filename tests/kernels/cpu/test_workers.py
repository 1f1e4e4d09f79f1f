"""The compiled kernels inside DataLoader workers, however those are started, after the parent used them too."""

from __future__ import annotations

from pathlib import Path

import pytest

from pcdata.contracts.dispatch import why_unavailable
from tests.warm import run_script

pytestmark = pytest.mark.skipif(why_unavailable("cpu") is not None, reason=str(why_unavailable("cpu")))

# A file of its own: spawned workers import it again, which a test module imported by pytest does not allow.
SCRIPT = """
import multiprocessing

import torch
from torch.utils.data import DataLoader, Dataset

import pcdata.functional as F


class Clouds(Dataset):
    def __len__(self):
        return 160

    def __getitem__(self, index):
        generator = torch.Generator().manual_seed(index)
        points = torch.randn(150 + index % 100, 3, generator=generator)
        mask = F.radius_outlier_mask(points, radius=0.5, min_neighbors=2, backend="cpu")
        label = F.dbscan(points, eps=0.6, min_points=4, backend="cpu")
        picked, _ = F.farthest_point_sample(points, num_samples=16)
        return torch.stack([mask.sum(), label.sum(), label.max(), picked.sum()])


if __name__ == "__main__":
    torch.set_num_threads(2)
    large = torch.randn(30_000, 3)  # enough for the parent's kernels to start threads
    F.radius_outlier_mask(large, radius=0.05, backend="cpu")
    F.dbscan(large, eps=0.05, min_points=4, backend="cpu")
    clouds = Clouds()
    expected = torch.stack([clouds[i] for i in range(len(clouds))])
    for number, method in enumerate(("fork", "forkserver", "spawn")):
        workers = multiprocessing.get_context(method)
        if method == "forkserver":
            workers.set_forkserver_preload(["torch", "pcdata.functional"])
        count = 1 if method == "spawn" else 2  # each loads torch anew
        loader = DataLoader(clouds, batch_size=4, num_workers=count, multiprocessing_context=workers, timeout=60)
        batches = list(loader)
        assert len(batches) == 40, method
        assert torch.equal(torch.cat(batches), expected), method
        F.dbscan(large, eps=0.05, min_points=4, backend="cpu")  # and the parent's still run
"""


def test_workers_give_what_the_parent_gives_however_they_start(tmp_path: Path):
    script = tmp_path / "workers.py"
    script.write_text(SCRIPT)
    result = run_script(script, folder=tmp_path)
    assert result.returncode == 0, result.stderr
