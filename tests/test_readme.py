"""The README's code runs, its errors are real, and the shipped configurations parse."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pcdata.build import load_config
from pcdata.cli.main import main
from pcdata.exports.registry import TARGETS
from pcdata.models.catalog import CONTRACTS
from pcdata.sensors.known_sensors import sensor_profiles
from tests.warm import run_script

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", README, flags=re.MULTILINE | re.DOTALL)


def test_readme_python_blocks_run_as_one_script(tmp_path: Path) -> None:
    script = tmp_path / "readme.py"
    script.write_text("\n".join(BLOCKS), encoding="utf-8")
    done = run_script(script, folder=ROOT)
    assert done.returncode == 0, done.stderr
    assert "torch.Size([2, 1024, 3]) base normalized" in done.stdout
    assert "base m [" in done.stdout
    assert "add ToFrame(frame='base') before it" in done.stdout


def test_the_folder_that_the_readme_shows_is_a_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = re.search(r"captures/intrinsics.json +(\{.*?\})\n", README, flags=re.DOTALL)
    assert text is not None
    for name in ("depth", "color", "poses"):
        (tmp_path / name).mkdir()
    (tmp_path / "intrinsics.json").write_text(text[1], encoding="utf-8")
    Image.fromarray(np.full((480, 640), 700, np.uint16)).save(tmp_path / "depth" / "0000.png")
    Image.fromarray(np.zeros((480, 640, 3), np.uint8)).save(tmp_path / "color" / "0000.jpg")
    np.savetxt(tmp_path / "poses" / "0000.txt", np.eye(4))
    assert main(["inspect", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    assert "poses     lead to 'base'" in told
    assert "unit      1 stored = 0.001 m" in told
    assert "not read" not in told


def test_readme_states_one_test_command_for_continuous_integration() -> None:
    block = re.findall(r"^<!-- test command -->\n```bash\n(.*?)^```$", README, flags=re.MULTILINE | re.DOTALL)
    assert len(block) == 1
    assert "pytest" in block[0]


def test_readme_counts_what_there_is() -> None:
    assert re.search(rf"for {len(CONTRACTS)}\s+contracts", README)
    assert f"# {len(TARGETS)} layouts" in README
    assert f"of {len(sensor_profiles())} sensors" in README


def test_readme_pictures_exist() -> None:
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", README)
    assert pictures
    assert all((ROOT / picture).is_file() for picture in pictures)


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*.yaml")), ids=lambda path: path.name)
def test_shipped_configuration_parses_and_can_be_cached(path: Path) -> None:
    config = load_config(path)
    assert config.pipeline.is_random, "the example shows augmentation"
    assert config.pipeline.fingerprint() == load_config(path).pipeline.fingerprint()


def test_readme_shows_the_benchmark_table_that_is_kept() -> None:
    done = run_script(ROOT / "benchmarks" / "operations.py", "--kept", folder=ROOT)
    assert done.returncode == 0, done.stderr
    table = done.stdout.strip()
    assert table.count("\n") > 20
    assert table in README
