"""MapLabels: other names for the classes of points."""

from __future__ import annotations

import torch

from pcdata.errors import ConfigError, DTypeError
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params, Transform


class MapLabels(Transform):
    """Rename labels by a table; several may get one name, and -1 is none.

    ``MapLabels(mapping=((10, 1), (252, 1), (11, 2)), others=0)`` makes the classes of a training set of those of a
    recording. To drop points by their label: KeepValues.

    Args:
        mapping: pairs of a label and what it becomes; two may be exchanged.
        others: what every other label becomes; None = it stays.
    """

    mapping: tuple[tuple[int, int], ...]
    others: int | None = None

    def check_fields(self) -> None:
        """Require a table that names every label once."""
        named = [old for old, _ in self.mapping]
        twice = sorted({old for old in named if named.count(old) > 1})
        if twice:
            raise ConfigError(f"MapLabels: mapping must name every label once, {twice} are named again")

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Look up every label."""
        if data.labels is None:
            raise DTypeError(
                "MapLabels: the cloud has no labels; put ClusterObjects before it, or load captures with them"
            )
        table = dict(self.mapping)
        found, inverse = data.labels.unique(return_inverse=True)
        new = [table.get(label, label if self.others is None else self.others) for label in found.tolist()]
        return data.with_fields(labels=torch.tensor(new, dtype=torch.int64, device=data.device)[inverse])
