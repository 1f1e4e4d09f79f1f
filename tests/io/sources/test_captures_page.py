"""The code of docs/captures.md runs, and the source that it shows is one."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import torch

from pcdata.io.sources.capture_source import checked_ids, episodes_of, signals_of

PAGE = (Path(__file__).parents[3] / "docs" / "captures.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, flags=re.MULTILINE | re.DOTALL)


def test_the_source_of_ones_own_on_the_page_keeps_the_protocol() -> None:
    said: dict[str, Any] = {}
    for block in BLOCKS:
        exec(compile(block, "docs/captures.md", "exec"), said)
    robot = said["Robot"]()
    assert checked_ids("test", robot) == robot.ids
    (episode,) = episodes_of(robot)
    assert episode.times == (0.0, 0.1, 0.2, 0.3, 0.4)
    frame = robot.load("step_002")
    assert frame.sample_id == "step_002"
    assert torch.equal(frame.recorded_signals["joints"].values, signals_of(robot, "step_002")["joints"].values)
    lines = next(block for block in BLOCKS if "class Robot" in block).split("\n\n\n")[0].strip().splitlines()
    assert len([line for line in lines if line]) <= 20
