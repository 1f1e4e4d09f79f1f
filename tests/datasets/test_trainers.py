"""Real trainers, where they are installed: every epoch has the draws that belong to it, also after a restart."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils.data import DataLoader, RandomSampler

from pcdata import CachedCloudDataset, CountedSampler, EpisodeWindows, collate_windows, set_epoch
from pcdata.build import build_dataset, config_from_yaml
from pcdata.datasets import WindowBatch
from pcdata.synthetic import TeleopSource

pytestmark = [
    pytest.mark.filterwarnings("ignore"),  # those of the trainers
    pytest.mark.filterwarnings("error::pcdata.datasets.RepeatedEpochWarning"),
]

PIPELINE = """
depth: [Deproject]
cloud: [ToFrame: {frame: base}, FarthestPointSample: {num_points: 16, if_short: repeat}]
augment: [RandomRotation: {degrees: 180}]
"""

Seen = dict[int, dict[str, torch.Tensor]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("trainers") / "set"
    build_dataset(config_from_yaml(PIPELINE), TeleopSource(num_episodes=1, num_views=1, size=(12, 16)), folder)
    return folder


def windows_of(folder: Path) -> EpisodeWindows:
    return EpisodeWindows(CachedCloudDataset(folder, seed=3), 2, 4)


def loader_of(windows: EpisodeWindows, workers: int = 0, *, counted: bool = True) -> DataLoader:
    sampler = RandomSampler(windows)
    return DataLoader(
        windows, batch_size=4, sampler=CountedSampler(sampler) if counted else sampler, collate_fn=collate_windows,
        num_workers=workers, persistent_workers=workers > 0, multiprocessing_context="fork" if workers else None,
    )  # fmt: skip


def note(seen: Seen, epoch: int, batch: WindowBatch) -> None:
    names = [batch.clouds.meta[batch.num_obs * row]["window"]["id"] for row in range(len(batch))]
    seen.setdefault(epoch, {}).update(zip(names, batch.points.clone()))


def assert_draws_belong_to_their_epochs(seen: Seen, folder: Path, epochs: list[int]) -> None:
    assert sorted(seen) == epochs
    windows = windows_of(folder)
    for epoch, points in seen.items():
        windows.set_epoch(epoch)
        assert len(points) == len(windows)
        for place, name in enumerate(windows.ids):
            assert torch.equal(points[name].flatten(0, 1), windows[place].points)


@pytest.mark.parametrize("workers", [0, 1])
def test_lightning_tells_the_epoch_through_a_counted_sampler_also_resumed(folder, tmp_path, workers):
    lightning = pytest.importorskip("lightning")
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)

    class Net(lightning.LightningModule):
        def __init__(self) -> None:
            super().__init__()
            self.layer, self.seen = torch.nn.Linear(3, 1), {}

        def training_step(self, batch: WindowBatch, number: int) -> torch.Tensor:
            note(self.seen, self.trainer.current_epoch, batch)
            loss = self.layer(batch.points).mean()
            self.log("loss", loss, on_epoch=True, batch_size=len(batch))
            return loss

        def train_dataloader(self) -> DataLoader:
            loader = loader_of(windows_of(folder), workers)
            set_epoch(loader, self.trainer.current_epoch)
            return loader

        def configure_optimizers(self) -> Any:
            return torch.optim.SGD(self.parameters(), 1e-3)

    def trainer(epochs: int) -> Any:
        return lightning.Trainer(
            max_epochs=epochs, accelerator="cpu", devices=1, logger=False, enable_checkpointing=False,
            enable_progress_bar=False, enable_model_summary=False,
        )  # fmt: skip

    first, resumed = Net(), Net()
    before = trainer(2)
    before.fit(first)
    before.save_checkpoint(tmp_path / "two.ckpt")
    assert_draws_belong_to_their_epochs(first.seen, folder, [0, 1])
    trainer(4).fit(resumed, ckpt_path=tmp_path / "two.ckpt")
    assert_draws_belong_to_their_epochs(resumed.seen, folder, [2, 3])


@pytest.mark.parametrize("counted", [False, True])
@pytest.mark.parametrize("start", [0, 2])
def test_accelerate_keeps_the_epoch_that_is_set(folder, start, counted):
    accelerate = pytest.importorskip("accelerate")
    loader = accelerate.Accelerator(cpu=True).prepare(loader_of(windows_of(folder), counted=counted))
    seen: Seen = {}
    for epoch in range(start, start + 2):
        if start:
            set_epoch(loader, epoch)
        for batch in loader:
            note(seen, epoch, batch)
    assert_draws_belong_to_their_epochs(seen, folder, [start, start + 1])


@pytest.mark.parametrize("counted", [False, True])
def test_fabric_keeps_the_epoch_that_is_set(folder, counted):
    fabric = pytest.importorskip("lightning").Fabric(accelerator="cpu", devices=1)
    loader = fabric.setup_dataloaders(loader_of(windows_of(folder), counted=counted))
    seen: Seen = {}
    for epoch in (2, 3):
        set_epoch(loader, epoch)
        for batch in loader:
            note(seen, epoch, batch)
    assert_draws_belong_to_their_epochs(seen, folder, [2, 3])


def test_the_page_on_training_runs_as_it_stands(capsys):
    page = (Path(__file__).parents[2] / "docs" / "training.md").read_text("utf-8")
    code = "\n".join(re.findall(r"^```python\n(.*?)^```$", page, flags=re.MULTILINE | re.DOTALL))
    exec(compile(code, "training.md", "exec"), {})
    assert capsys.readouterr().out.strip() == code.rsplit("# ", 1)[1].strip()
