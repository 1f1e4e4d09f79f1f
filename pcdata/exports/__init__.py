"""Exports: built clouds and captures in the layouts that the models' own loaders open, unmodified."""

from pcdata.exports.check import check_export, is_export
from pcdata.exports.export import ExportReport, export_dataset
from pcdata.exports.registry import TARGETS, register_target
from pcdata.exports.target import Item, Target

__all__ = [
    "TARGETS",
    "ExportReport",
    "Item",
    "Target",
    "check_export",
    "export_dataset",
    "is_export",
    "register_target",
]
