"""SplitObjects: a cloud of every object."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pcdata.contracts.on_host import counts_of
from pcdata.errors import DTypeError, ReplayError, TooFewPointsError
from pcdata.functional.rows import cloud_of_rows, count_per_cloud, ptr_from_counts
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
        owner, labeled = cloud_of_rows(data.ptr), data.labels >= 0
        counts = count_per_cloud(labeled, data.ptr)
        for b, count in enumerate(counts.tolist()):
            if count == 0:
                raise TooFewPointsError(
                    f"SplitObjects: cloud {b}{sample_name(data, b)} has no labeled point among its "
                    f"{int(data.counts[b])}; check the fields of ClusterObjects"
                )
        self.check_drop(counts_of(data.ptr), counts.tolist(), lambda b: f"points of cloud {b}{sample_name(data, b)}")
        names, number = torch.unique(data.labels[labeled], return_inverse=True)
        found = torch.unique(owner[labeled] * len(names) + number).cpu()
        cloud, label = found // len(names), names.cpu()[found % len(names)]
        ptr = ptr_from_counts(torch.bincount(cloud, minlength=data.num_clouds))
        rank = torch.arange(len(found), dtype=torch.int64, device="cpu") - ptr[cloud]
        return {"label": label, "rank": rank, "ptr": ptr}

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
        """Sort the labeled rows by object."""
        assert data.labels is not None  # make_params
        wanted, ptr = params["label"].to(data.device), params["ptr"].to(data.device)
        names, number = torch.unique(torch.cat([data.labels, wanted]), return_inverse=True)
        owner, clouds = cloud_of_rows(data.ptr), cloud_of_rows(ptr)
        key, of_object = owner * len(names) + number[: len(owner)], clouds * len(names) + number[len(owner) :]
        place = torch.searchsorted(of_object, key).clamp(max=len(of_object) - 1)
        rows = ((of_object[place] == key) & (data.labels >= 0)).nonzero().squeeze(1)
        place = place[rows]
        counts = torch.bincount(place, minlength=len(wanted))
        split = data.parted(rows[place.argsort(stable=True)], ptr_from_counts(counts), clouds)
        unlabeled = count_per_cloud(data.labels < 0, data.ptr).tolist()
        told = zip(params["label"].tolist(), clouds.tolist(), strict=True)
        return split.with_meta([{"object": label, "unlabeled": unlabeled[b]} for label, b in told])
