"""SplitObjects: a cloud of every object."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pcdata.contracts.on_host import bounds_of, counts_of
from pcdata.errors import DTypeError, ReplayError, TooFewPointsError
from pcdata.functional.rows import ptr_from_counts
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params, sample_name
from pcdata.transforms.decisions import Decision, Decisions
from pcdata.transforms.families import DropLimit


class SplitObjects(DropLimit):
    """Make one cloud of every label >= 0, in order of cloud and label; points without a label are dropped.

    ``meta["object"]`` keeps the label, ``meta["unlabeled"]`` the number of points dropped from the whole cloud.
    """

    keeps_clouds = False

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Find the labels of every cloud: ``label`` (K,), its ``rank`` in its cloud, and the ``ptr`` (B+1,) of them."""
        if data.labels is None:
            raise DTypeError("SplitObjects: the cloud has no labels; put ClusterObjects before it")
        found = [torch.unique(own[own >= 0]).cpu() for own in torch.tensor_split(data.labels, data.ptr[1:-1].cpu())]
        for b, labels in enumerate(found):
            if not len(labels):
                raise TooFewPointsError(
                    f"SplitObjects: cloud {b}{sample_name(data, b)} has no labeled point among its "
                    f"{int(data.counts[b])}; check the fields of ClusterObjects"
                )
        member = torch.nn.functional.pad((data.labels >= 0).cumsum(0), (1, 0))
        self.check_drop(
            counts_of(data.ptr),
            member[data.ptr].diff().tolist(),
            lambda b: f"points of cloud {b}{sample_name(data, b)}",
        )
        ranks = [torch.arange(len(labels), dtype=torch.int64, device="cpu") for labels in found]
        return {
            "label": torch.cat(found),
            "rank": torch.cat(ranks),
            "ptr": ptr_from_counts([len(labels) for labels in found]),
        }

    def repeat(self, data: PointCloud, decided: Decisions) -> Params:
        """The objects with the labels that the history tells."""
        like = torch.empty(0, dtype=torch.int64, device="cpu")
        starts = [number for number, _ in self.origins(decided.of_clouds)]
        if data.labels is None or len(starts) != data.num_clouds:
            raise ReplayError(
                f"SplitObjects: the histories tell of objects of {len(starts)} clouds, and there are {data.num_clouds}"
                f"{' without labels' if data.labels is None else ''}; give clouds with the same labels"
            )
        ptr = torch.tensor([*starts, len(decided)], dtype=torch.int64, device="cpu")
        return {"label": decided.values("label", like=like), "rank": decided.values("rank", like=like), "ptr": ptr}

    def origins(self, decisions: Sequence[Decision]) -> list[tuple[int, int | None]]:
        """A cloud's objects come in the order of their ranks."""
        ranks = Decisions("SplitObjects", decisions).values("rank").tolist()
        return [(k, None) for k, rank in enumerate(ranks) if k == 0 or rank <= ranks[k - 1]]

    def transform(self, data: PointCloud, params: Params) -> PointCloud:
        """Split each cloud by its labels."""
        bounds = bounds_of(params["ptr"])
        parts = []
        for b, cloud in enumerate(data.unbatch()):
            assert cloud.labels is not None  # make_params
            unlabeled = int((cloud.labels < 0).sum())
            for label in params["label"][bounds[b] : bounds[b + 1]].tolist():
                rows = torch.nonzero(cloud.labels == label).squeeze(1)
                ptr = torch.tensor([0, len(rows)], dtype=torch.int64, device=cloud.device)
                parts.append(cloud.select(rows, ptr).with_meta([{"object": label, "unlabeled": unlabeled}]))
        return PointCloud.cat(parts)
