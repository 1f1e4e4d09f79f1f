"""Optional dependencies: a missing one is told with its purpose and the exact command."""

from __future__ import annotations

import importlib.util
import re
import types
from pathlib import Path

import pytest
import tomllib

from pcdata import extras
from pcdata.errors import MissingExtraError

PACKAGES = {
    "cuda.core": "cuda_core",
    "cv2": "opencv_python_headless",
    "rerun": "rerun_sdk",
}  # where it is no module
PYPROJECT = tomllib.loads((Path(__file__).resolve().parents[1] / "pyproject.toml").read_text())


@pytest.fixture
def absent(monkeypatch):
    """Make the named modules look as if they were not installed."""
    find = importlib.util.find_spec

    def hide(*names: str) -> None:
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in names else find(name))

    return hide


@pytest.mark.parametrize("module", sorted(extras.EXTRAS))
def test_an_absent_dependency_is_told_with_purpose_and_command(absent, module):
    absent(module)
    with pytest.raises(MissingExtraError) as caught:
        extras.require(module)
    message = str(caught.value)
    assert message == extras.why_missing(module)
    assert f"{module} is not installed" in message
    assert extras.EXTRAS[module].purpose in message
    assert message.endswith(f"run {extras.EXTRAS[module].install}")
    assert "pip install" in message


def test_the_error_is_an_import_error_too(absent):
    absent("open3d")
    with pytest.raises(ImportError):
        extras.require("open3d")


@pytest.mark.parametrize("module", sorted(extras.EXTRAS))
def test_every_command_names_what_the_project_s_metadata_offers(module):
    extra = extras.EXTRAS[module]
    offered = [re.split(r"[>=<]", text)[0] for text in PYPROJECT["project"]["optional-dependencies"][extra.name]]
    package = PACKAGES.get(module, module)
    assert package in [name.replace("-", "_") for name in offered]
    assert f"pcdata[{extra.name}]" in extra.install or module.replace("_", "-") in extra.install


def test_an_installed_dependency_is_the_module_itself(monkeypatch):
    module = types.ModuleType("matplotlib")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(extras.importlib, "import_module", lambda name: module)
    assert extras.require("matplotlib") is module
    assert extras.why_missing("matplotlib") is None


@pytest.mark.parametrize(
    "error", [ImportError("libGL.so.1: cannot open"), OSError("undefined symbol"), AttributeError("_ARRAY_API")]
)
@pytest.mark.parametrize(("module", "word"), [("open3d", "apt-get install"), ("torch_cluster", "reinstall")])
def test_one_that_is_installed_but_broken_says_so_and_what_to_do(monkeypatch, error, module, word):
    def broken(name: str):
        raise error

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(extras.importlib, "import_module", broken)
    with pytest.raises(MissingExtraError, match="installed but cannot be loaded") as caught:
        extras.require(module)
    assert str(error) in str(caught.value)
    assert word in str(caught.value)
