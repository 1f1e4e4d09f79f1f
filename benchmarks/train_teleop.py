"""Train a small policy on a simulated teleoperated set, and the same where actions are left out of the augmentation.

    python benchmarks/train_teleop.py     # some minutes on one core; writes results/train_teleop.json and a picture

Task: bring a red cube to a green disc (``pcdata.synthetic.TeleopSource``: 30 demonstrations, 3 cameras). The policy has
the newest cloud of a window and whether the hand is open, and says where to go and whether to open there: the next
actions of ``EpisodeWindows``. The clouds of every window are turned about z by any angle. In one training the actions
turn with them, as ``cloud.signals`` gives them; in the other they stay as they were recorded, as where actions travel
beside the clouds. Success: in a world that the policy steps by itself, from starts that no demonstration had, the cube
lies within 3 cm of the goal's middle in the end. Every training runs with several seeds, which start the weights and
order the windows.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from pcdata import CloudDataset, Compose, EpisodeWindows, PointCloud, collate_windows
from pcdata.datasets import WindowBatch
from pcdata.extras import require as require_extra
from pcdata.rng import seeded
from pcdata.structures import Signal
from pcdata.synthetic import TeleopSource
from pcdata.synthetic.teleop import start
from pcdata.transforms import RandomRotation

RESULTS = Path(__file__).parent / "results"
PIPELINE = """
depth: [Deproject]
cloud:
  - ToFrame: {frame: base}
  - MergeViews
  - CropWorkspace: {frame: base, lower: [-0.4, -0.4, 0.004], upper: [0.4, 0.4, 0.5]}
  - FarthestPointSample: {num_points: 128, if_short: repeat}
"""
SIZE = (60, 80)  # pixels of each camera
WITHIN = 0.03  # metres
TRIALS = 10
TRIED_AFTER = (1, 2, 3, 5, 10, 15)  # epochs, besides none and all
MOST_STEPS = 40
UNSEEN = 10_000  # the first seed of the trials
WAYS = {"actions move with the cloud": True, "actions are left out": False}


class Policy(nn.Module):
    """PointNet's shared layers and maximum; the target is a mean of points that the network weighs, and an offset."""

    def __init__(self) -> None:
        super().__init__()
        self.points = nn.Sequential(nn.Linear(7, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU())
        self.weights = nn.Sequential(nn.Linear(64 + 64, 64), nn.ReLU(), nn.Linear(64, 1))
        self.offset = nn.Sequential(nn.Linear(64, 32), nn.ReLU(), nn.Linear(32, 3))
        self.opening = nn.Sequential(nn.Linear(2, 32), nn.ReLU(), nn.Linear(32, 1))

    def forward(self, points: Tensor, colors: Tensor, gripper: Tensor, hand: Tensor) -> Tensor:
        """Say what to do.

        Args:
            points: (B, N, 3).
            colors: (B, N, 3).
            gripper: (B, 1), 1 = open.
            hand: (B, 3) where it is.

        Returns:
            (B, 4): x, y, z to go to, and the logit of opening there.
        """
        state = gripper[:, None].expand(-1, points.shape[1], -1)
        features = self.points(torch.cat([points * 4, colors * 2 - 1, state * 2 - 1], dim=-1))
        whole = features.amax(dim=1)
        weights = 10 * self.weights(torch.cat([features, whole[:, None].expand_as(features)], dim=-1))
        weights = weights.softmax(dim=1)
        target = (weights * points).sum(dim=1) + 0.05 * self.offset((weights * features).sum(dim=1))
        gap = (target - hand).norm(dim=-1, keepdim=True)
        return torch.cat([target, self.opening(torch.cat([gap.detach() * 100, gripper * 2 - 1], dim=-1))], dim=-1)

    def of(self, batch: WindowBatch) -> Tensor:
        """Say what to do at the newest cloud of every window."""
        hand = batch.signals["hand"][:, -1, :3, 3]
        return self(batch.points[:, -1], batch.field("colors")[:, -1], batch.signals["gripper"][:, -1], hand)


@dataclass(frozen=True)
class Run:
    """One training: what was learned, and the share of trials that succeeded as it went on."""

    policy: Policy
    epochs: list[int]  # after how many it was tried
    success: list[float]  # then
    error: list[float]  # metres, of the targets in every epoch of training


def loss_of(said: Tensor, action: Tensor) -> Tensor:
    """Metres off the target, in centimetres, and the opening."""
    place = nn.functional.smooth_l1_loss(said[:, :3] * 100, action[:, :3] * 100)
    return place + nn.functional.binary_cross_entropy_with_logits(said[:, 3], action[:, 3])


def train(windows: EpisodeWindows, *, moved: bool, epochs: int, seed: int, trials: int, size: tuple[int, int]) -> Run:
    """Train on the windows; without ``moved`` the actions are those recorded, whatever was done to the clouds."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        policy = Policy()
    # The head that opens learns from few steps: those at the cube and at the goal.
    sees = [value for name, value in policy.named_parameters() if not name.startswith("opening")]
    groups = [{"params": sees, "lr": 2e-3}, {"params": policy.opening.parameters(), "lr": 2e-2}]
    optimizer = torch.optim.Adam(groups)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs)
    loader = DataLoader(windows, batch_size=16, shuffle=True, collate_fn=collate_windows, generator=seeded(seed))
    run = Run(policy, [0], [success(policy, trials, size)], [])
    for epoch in range(epochs):
        windows.set_epoch(epoch + 1000 * seed)
        errors = []
        for batch in loader:
            recorded = batch.clouds.recorded_signals["action"].values[windows.num_obs - 1 :: windows.num_obs]
            action = (batch.signals["action"] if moved else recorded)[:, windows.num_obs - 1]
            said = policy.of(batch)
            loss = loss_of(said, action)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            errors.append((said[:, :3] - action[:, :3]).norm(dim=-1).detach())
        schedule.step()
        run.error.append(round(float(torch.cat(errors).mean()), 4))
        if epoch + 1 in TRIED_AFTER or epoch + 1 == epochs:
            run.epochs.append(epoch + 1)
            run.success.append(success(policy, trials, size))
    return run


def success(policy: Policy, trials: int, size: tuple[int, int]) -> float:
    """The share of trials in which the policy, left alone, brings the cube within 3 cm of the goal."""
    source, pipeline = TeleopSource(num_episodes=1, size=size), Compose.from_yaml(PIPELINE)
    states = [start(UNSEEN + trial) for trial in range(trials)]
    for _ in range(MOST_STEPS):
        # What was brought there and let go stays.
        active = [n for n, state in enumerate(states) if state.holds or state.distance > WITHIN]
        if not active:
            break
        clouds = [pipeline(source.render(states[n], f"trial-{n}")) for n in active]
        batch = collate_windows(clouds)
        with torch.no_grad():
            said = policy.of(batch)
        for n, (x, y, z, opening) in zip(active, said.tolist(), strict=True):
            states[n] = states[n].next((x, y, z), float(opening > 0))
    return sum(not state.holds and state.distance <= WITHIN for state in states) / trials


class InMemory:
    """The clouds of a source as a pipeline leaves them, made once: with their signals and episodes a source again."""

    name = "in memory"

    def __init__(self, source: TeleopSource, pipeline: Compose) -> None:
        self.ids, self.episodes = source.ids, source.episodes
        self.clouds = {sample_id: pipeline(source.load(sample_id)) for sample_id in self.ids}

    def __len__(self) -> int:
        return len(self.ids)

    def load(self, sample_id: str) -> PointCloud:
        return self.clouds[sample_id]

    def signals(self, sample_id: str) -> dict[str, Signal]:
        return dict(self.clouds[sample_id].recorded_signals)


def demonstrations(episodes: int, size: tuple[int, int]) -> EpisodeWindows:
    """The windows of the set, each turned about z by an angle of its own."""
    source = InMemory(TeleopSource(num_episodes=episodes, size=size), Compose.from_yaml(PIPELINE))
    return EpisodeWindows(CloudDataset(source, Compose([RandomRotation(degrees=180)])), num_obs=2, horizon=8)


def draw(rows: dict[str, Any], path: Path) -> None:
    """Draw the mean curves of every training, and around them the range of its seeds."""
    require_extra("matplotlib")
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    def curve(axes: Axes, epochs: list[int], seeds: list[list[float]], scale: float, label: str) -> None:
        values = scale * torch.tensor(seeds)
        (line,) = axes.plot(epochs, values.mean(dim=0).tolist(), label=label)
        low, high = values.amin(dim=0).tolist(), values.amax(dim=0).tolist()
        axes.fill_between(epochs, low, high, color=line.get_color(), alpha=0.2)

    figure = Figure(figsize=(9, 3.6), layout="constrained")
    arrived, error = figure.subplots(1, 2)
    for name, row in rows.items():
        curve(arrived, row["epochs"], row["success"], 100, name)
        errors = row["training_error_metres"]
        curve(error, list(range(1, len(errors[0]) + 1)), errors, 1000, name)
    arrived.set(xlabel="epochs of training", ylabel="trials in which the cube arrives, %", ylim=(-3, 103))
    error.set(xlabel="epoch", ylabel="error of the targets in training, mm", yscale="log")
    for axes in (arrived, error):
        axes.grid(alpha=0.3)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    arrived.legend(loc="center right")
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--episodes", type=int, default=30)
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--trials", type=int, default=TRIALS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows: dict[str, Any] = {}
    windows = demonstrations(arguments.episodes, SIZE)
    print(windows)
    for name, moved in WAYS.items():
        begun = time.process_time()
        runs = [
            train(windows, moved=moved, epochs=arguments.epochs, seed=seed, trials=arguments.trials, size=SIZE)
            for seed in range(arguments.seeds)
        ]  # fmt: skip
        seconds = (time.process_time() - begun) / arguments.seeds
        final = [run.success[-1] for run in runs]
        rows[name] = {
            "mean": round(sum(final) / len(final), 4),
            "worst": min(final),
            "epochs": runs[0].epochs,
            "success": [run.success for run in runs],
            "training_error_metres": [run.error for run in runs],
            "seconds_each": round(seconds, 1),
        }
        print(f"{name}: mean {rows[name]['mean']:.0%}, worst {rows[name]['worst']:.0%}, {seconds:.0f} s each")
    document = {
        "benchmark": "train_teleop",
        "episodes": arguments.episodes,
        "windows": len(windows),
        "trials": arguments.trials,
        "seeds": arguments.seeds,
        "within_metres": WITHIN,
        "trainings": rows,
    }
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "train_teleop.json").write_text(json.dumps(document, indent=1) + "\n")
    draw(rows, Path(__file__).parents[1] / "docs" / "episodes.png")


if __name__ == "__main__":
    main()
