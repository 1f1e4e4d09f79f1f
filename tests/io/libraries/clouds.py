"""Clouds with a field of every kind, to be handed to other libraries."""

from __future__ import annotations

import torch

from pcdata.structures import PointCloud


def full_cloud(num_points: int = 40, seed: int = 0) -> PointCloud:
    """A cloud in "base" that has everything."""
    generator = torch.Generator().manual_seed(seed)
    n = num_points
    cloud = PointCloud(
        points=torch.rand(n, 3, generator=generator),
        frame_id="base",
        colors=torch.randint(0, 256, (n, 3), generator=generator) / 255,
        normals=torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=1),
        labels=torch.arange(n) % 5 - 1,
        source_index=torch.arange(n) * 3,
        extra={
            "confidence": torch.arange(n).to(torch.uint8) % 4,
            "view": torch.arange(n, dtype=torch.int64) % 2,
            "score": torch.rand(n, dtype=torch.float64, generator=generator),
            "feature": torch.randn(n, 4, generator=generator),
            "column": torch.randn(n, 1, generator=generator),
            "approach": torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=1),
            "inside": torch.arange(n) % 3 == 0,
        },
        kinds={
            "confidence": "minimum",
            "view": "invariant",
            "score": "invariant",
            "feature": "invariant",
            "column": "invariant",
            "approach": "direction",
            "inside": "invariant",
        },
        viewpoint=torch.tensor([[0.0, 0.0, 1.5]]),
        frames={"world": torch.eye(4, dtype=torch.float64)[None]},
        meta=({"sample_id": f"s{seed}"},),
    )
    turned = torch.eye(4, dtype=torch.float64)
    turned[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
    return cloud.transformed(turned[None], frame_id="table").with_signal(
        "joints", torch.full((1, 7), float(seed)), "invariant"
    )


def check_same(found: PointCloud, wanted: PointCloud) -> None:
    """Require every field, and all that the clouds know, to be the same to the bit."""
    assert found.frame_id == wanted.frame_id
    assert found.unit == wanted.unit
    assert found.kinds == wanted.kinds
    assert found.source_frame == wanted.source_frame
    assert torch.equal(found.ptr, wanted.ptr)
    assert torch.equal(found.source_from_cloud, wanted.source_from_cloud)
    assert found.frames.keys() == wanted.frames.keys()
    assert found.meta == wanted.meta
    assert found.history == wanted.history
    assert found.signals.keys() == wanted.signals.keys()
    assert found.fields().keys() == wanted.fields().keys()
    for name, value in wanted.fields().items():
        assert found.fields()[name].dtype == value.dtype, name
        assert torch.equal(found.fields()[name], value), name
