"""What torch makes by default (dtype, device) never reaches pcdata: every tensor that it makes says both."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import pcdata

ROOT = Path(pcdata.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))

# Functions that make a tensor out of no tensor: without dtype= and device= they follow torch's global defaults.
FACTORIES = {
    "arange",
    "as_tensor",
    "asarray",
    "empty",
    "eye",
    "full",
    "linspace",
    "logspace",
    "normal",
    "ones",
    "rand",
    "randint",
    "randn",
    "randperm",
    "scalar_tensor",
    "tensor",
    "tril_indices",
    "triu_indices",
    "zeros",
}
ALWAYS_INT64 = {"randint", "randperm", "tril_indices", "triu_indices"}


def silent_defaults(source: str) -> list[str]:
    """The calls of torch's factories that leave dtype or device to the global default."""
    faults = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
            continue
        owner, name = node.func.value, node.func.attr
        if not isinstance(owner, ast.Name) or owner.id != "torch" or name not in FACTORIES:
            continue
        needed = {"device"} if name in ALWAYS_INT64 else {"dtype", "device"}
        missing = needed - {keyword.arg for keyword in node.keywords}
        if missing:
            faults.append(f"line {node.lineno}: torch.{name} without {' and '.join(sorted(missing))}")
    return faults


@pytest.mark.parametrize("path", FILES, ids=[str(path.relative_to(ROOT)) for path in FILES])
def test_every_tensor_made_from_nothing_names_its_dtype_and_device(path):
    assert silent_defaults(path.read_text(encoding="utf-8")) == []


def test_the_rule_sees_what_it_is_for():
    assert silent_defaults("x = torch.zeros(3)") == ["line 1: torch.zeros without device and dtype"]
    assert silent_defaults("x = torch.arange(3, device=y.device)") == ["line 1: torch.arange without dtype"]
    assert silent_defaults("x = torch.randperm(3, generator=g)") == ["line 1: torch.randperm without device"]
    assert silent_defaults("x = torch.eye(3, dtype=torch.float64, device='cpu')") == []
    assert silent_defaults("x = y.new_zeros(3)") == []
