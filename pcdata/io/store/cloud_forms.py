"""Clouds of records that differ in their rows alone: what is the same in all of them is checked once."""

from __future__ import annotations

from typing import Any
from urllib.parse import unquote

import numpy as np
import torch

from pcdata.io.store.cloud_record import EXTRA, FRAMES, Record, cloud_from_record
from pcdata.structures import PointCloud
from pcdata.structures.read_later import Histories, Metas, StoredMeta
from pcdata.structures.structure import derived


class CloudForms:
    """Makes clouds of joined records; of the second and later ones of a form only what differs is put in."""

    def __init__(self) -> None:
        self._known: dict[Any, _CloudForm | None] = {}

    def cloud(self, record: Record) -> PointCloud:
        """Return :func:`cloud_from_record` of a record of clouds that were joined.

        Raises:
            CacheError: as there.
        """
        # Joining has compared the rows of all arrays with the row pointers.
        is_unread = record.form is not None and isinstance(record.info.get("meta"), StoredMeta)
        form = self._known.get(record.form) if is_unread else None
        if form is not None:
            return form.cloud(record)
        cloud = cloud_from_record(record)
        if is_unread and record.form not in self._known and all(array.size for array in record.arrays.values()):
            self._known[record.form] = _form_of(cloud, record)
        return cloud

    def __reduce__(self) -> tuple[Any, ...]:
        return CloudForms, ()  # forms are those of a process


class _CloudForm:
    """A cloud of some form, and where the arrays of its record are in it."""

    def __init__(self, cloud: PointCloud, places: dict[str, tuple[str, str]]) -> None:
        self._cloud = derived(
            cloud, **{name: None for owner, name in places.values() if not owner}, extra={}, frames={}
        )
        self._places = places

    def cloud(self, record: Record) -> PointCloud:
        """Return the cloud of another record of the form."""
        own: dict[str, Any] = {"extra": {}, "frames": {}}
        for name, array in record.arrays.items():
            owner, place = self._places[name]
            (own[owner] if owner else own)[place] = torch.from_numpy(array)
        meta, history = Metas([record.info["meta"]]), Histories([record.info["history"]])
        return derived(self._cloud, **own, meta=meta, history=history)


def _form_of(cloud: PointCloud, record: Record) -> _CloudForm | None:
    """Return the form of a record, or None where the cloud is more than its arrays as they are."""
    if cloud.recorded_signals:  # whose values are checked
        return None
    places = {}
    for name, array in record.arrays.items():
        place = ("", name)
        for prefix, owner in ((EXTRA, "extra"), (FRAMES, "frames")):
            if name.startswith(prefix):
                place = owner, unquote(name.removeprefix(prefix)) if owner == "frames" else name.removeprefix(prefix)
        owner, own = place
        held = vars(cloud)[owner].get(own) if owner else vars(cloud).get(own)
        if not (isinstance(held, torch.Tensor) and _is_array(held, array)):
            return None
        places[name] = place
    held_in_all = sum(isinstance(value, torch.Tensor) for value in vars(cloud).values())
    if held_in_all + len(cloud.extra) + len(cloud.frames) != len(places):
        return None
    return _CloudForm(cloud, places)


def _is_array(tensor: torch.Tensor, array: np.ndarray) -> bool:
    own = tensor.numpy()
    same = own.__array_interface__["data"] == array.__array_interface__["data"]
    return bool(same and own.dtype == array.dtype and own.shape == array.shape)
