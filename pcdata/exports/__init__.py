"""Exports: built clouds and captures in the layouts that the models' own loaders open, unmodified."""

from pcdata.exports.check import check_export, is_export
from pcdata.exports.export import ExportReport, export_dataset
from pcdata.exports.registry import TARGETS
from pcdata.exports.target import Target

__all__ = ["TARGETS", "ExportReport", "Target", "check_export", "export_dataset", "is_export"]
