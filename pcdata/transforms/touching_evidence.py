"""What parted and joined objects that touch, as params of ClusterObjects and as its ``meta``."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pcdata.functional.touching import REASONS, Separation
from pcdata.transforms.base import Params


def evidence_params(found: list[Separation], before: list[Tensor], after: list[Tensor]) -> Params:
    """Lay what was found out as tensors, with the labels that objects have at last; what is no object is left out."""
    cuts: list[tuple[float, ...]] = []
    joins: list[tuple[int, ...]] = []
    for b, separation in enumerate(found):
        new_of = torch.full((int(before[b].max()) + 2 if len(before[b]) else 1,), -1, dtype=torch.int64, device="cpu")
        new_of[before[b].cpu() + 1] = after[b].cpu()  # all rows of an object have one new label
        name = {old: new for old, new in enumerate(new_of[1:].tolist()) if new >= 0}
        for cut in separation.cuts:
            if all(one in name for one in cut.objects):
                cuts.append((b, *sorted(name[one] for one in cut.objects), cut.strength, cut.num_pixels))
        joins += [(b, name[join.object], REASONS.index(join.why)) for join in separation.joins if join.object in name]
    return {
        "depth_noise": torch.tensor([one.noise for one in found], dtype=torch.float64, device="cpu"),
        "cuts": torch.tensor(sorted(cuts), dtype=torch.float64, device="cpu").reshape(-1, 5),
        "joins": torch.tensor(sorted(joins), dtype=torch.int64, device="cpu").reshape(-1, 3),
    }


def evidence_told(params: Params, b: int) -> dict[str, Any]:
    """Tell what parted and joined the objects of cloud ``b``."""
    return {
        "noise": float(params["depth_noise"][b]),
        "cuts": [
            {"objects": [int(one), int(other)], "strength": round(strength, 3), "pixels": int(pixels)}
            for cloud, one, other, strength, pixels in params["cuts"].tolist()
            if cloud == b
        ],
        "joins": [
            {"object": label, "why": REASONS[why]} for cloud, label, why in params["joins"].tolist() if cloud == b
        ],
    }
