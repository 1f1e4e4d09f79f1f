"""Offline builds: a configuration and a source in, a dataset on disk out."""

from pcdata.build.builder import BuildReport, build_dataset
from pcdata.build.card import write_card
from pcdata.build.config import BuildConfig, config_from_yaml, load_config
from pcdata.build.outlook import Outlook, outlook
from pcdata.build.plan import plan_of
from pcdata.build.records import BuiltSample
from pcdata.build.verification import DatasetFault, DatasetVerdict, verify_dataset

__all__ = [
    "BuildConfig",
    "BuildReport",
    "BuiltSample",
    "DatasetFault",
    "DatasetVerdict",
    "Outlook",
    "build_dataset",
    "config_from_yaml",
    "load_config",
    "outlook",
    "plan_of",
    "verify_dataset",
    "write_card",
]
