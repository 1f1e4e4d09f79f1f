"""Datasets of clouds and the collate functions that feed a DataLoader."""

from pcdata.datasets.cached import CachedCloudDataset
from pcdata.datasets.clouds import CloudDataset
from pcdata.datasets.collate import COLLATES, collate_fixed, collate_packed, collate_padded, register_collate
from pcdata.datasets.copies import CountedSampler
from pcdata.datasets.passes import RepeatedEpochWarning
from pcdata.datasets.samples import SampleDataset

__all__ = [
    "COLLATES",
    "CachedCloudDataset",
    "CloudDataset",
    "CountedSampler",
    "RepeatedEpochWarning",
    "SampleDataset",
    "collate_fixed",
    "collate_packed",
    "collate_padded",
    "register_collate",
]
