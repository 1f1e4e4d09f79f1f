"""Datasets of clouds and the collate functions that feed a DataLoader."""

from pcdata.datasets.cached import CachedCloudDataset
from pcdata.datasets.clouds import CloudDataset
from pcdata.datasets.collate import (
    COLLATES,
    collate_fixed,
    collate_packed,
    collate_padded,
    collate_windows,
    register_collate,
)
from pcdata.datasets.copies import CountedSampler
from pcdata.datasets.device_pipeline import DevicePipeline
from pcdata.datasets.epoch_setting import set_epoch
from pcdata.datasets.mixed import MixedCloudDataset
from pcdata.datasets.normalizers import LinearNormalizer, fit_normalizers
from pcdata.datasets.passes import RepeatedEpochWarning
from pcdata.datasets.samples import SampleDataset
from pcdata.datasets.split_dataset import split_dataset
from pcdata.datasets.splits import Splits
from pcdata.datasets.streamed import StreamedCloudDataset
from pcdata.datasets.window_batch import WindowBatch
from pcdata.datasets.windows import EpisodeWindows

__all__ = [
    "COLLATES",
    "CachedCloudDataset",
    "CloudDataset",
    "CountedSampler",
    "DevicePipeline",
    "EpisodeWindows",
    "LinearNormalizer",
    "MixedCloudDataset",
    "RepeatedEpochWarning",
    "SampleDataset",
    "Splits",
    "StreamedCloudDataset",
    "WindowBatch",
    "collate_fixed",
    "collate_packed",
    "collate_padded",
    "collate_windows",
    "fit_normalizers",
    "register_collate",
    "set_epoch",
    "split_dataset",
]
