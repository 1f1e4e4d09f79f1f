"""Exports: built clouds and captures in the layouts that the models' own loaders open, unmodified."""

from pcdata.exports.cloud_files import write_clouds
from pcdata.exports.export_check import check_export, is_export
from pcdata.exports.exporter import export_dataset
from pcdata.exports.registry import register_target, targets_of
from pcdata.exports.target import Item, Target
from pcdata.exports.targets import TARGETS

__all__ = [
    "TARGETS",
    "Item",
    "Target",
    "check_export",
    "export_dataset",
    "is_export",
    "register_target",
    "targets_of",
    "write_clouds",
]
