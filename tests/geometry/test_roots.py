from __future__ import annotations

import numpy as np
import pytest
import torch

from pcdata.geometry.roots import square_root
from tests import pretend_device
from tests.pretend_device import host, pretend, watching


def _values() -> torch.Tensor:
    generator = np.random.default_rng(0)
    some = np.exp(generator.uniform(-300, 300, 200_000))
    # Beside the square of a number halfway between two roots: the hardest there are.
    middle = generator.uniform(1, 2, 100_000)
    hard = (middle.astype(np.longdouble) + np.spacing(middle).astype(np.longdouble) / 2) ** 2
    hard = hard.astype(np.float64)
    beside = [np.nextafter(hard, np.inf), hard, np.nextafter(hard, 0.0)]
    powers = 2.0 ** np.arange(-60, 60)
    return torch.from_numpy(
        np.concatenate([some, *beside, powers, np.nextafter(powers, 0), np.nextafter(powers, np.inf), [0.0, np.inf]])
    )


@pytest.mark.skipif(not pretend_device.AVAILABLE, reason="this PyTorch has no devices written in Python")
def test_a_root_that_torch_rounds_wrongly_is_put_right_without_waiting(monkeypatch):
    values = _values()
    expected = torch.from_numpy(np.sqrt(values.numpy()))  # correctly rounded, as IEEE 754 wants it
    given = torch.Tensor.sqrt
    for units in (0, 1, -1):  # as a device might give it

        def off(tensor: torch.Tensor, units: int = units) -> torch.Tensor:
            root = pretend(expected)
            way = torch.full_like(root, torch.inf if units > 0 else 0.0)
            return torch.where((root > 0) & root.isfinite() & (units != 0), torch.nextafter(root, way), root)

        monkeypatch.setattr(torch.Tensor, "sqrt", off)
        with watching() as watched:
            found = square_root(pretend(values))
        monkeypatch.setattr(torch.Tensor, "sqrt", given)
        assert torch.equal(host(found), expected)
        assert not watched.waits
    assert torch.equal(square_root(values), expected)


def test_what_has_no_root_has_none():
    assert square_root(torch.tensor([-1.0, torch.nan], dtype=torch.float64)).isnan().all()
    if pretend_device.AVAILABLE:
        assert host(square_root(pretend(torch.tensor([-1.0, torch.nan], dtype=torch.float64)))).isnan().all()
