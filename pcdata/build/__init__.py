"""Offline builds: a configuration and a source in, a dataset on disk out."""

from pcdata.build.builder import BuildReport, BuiltSample, build_dataset
from pcdata.build.config import BuildConfig, config_from_yaml, load_config
from pcdata.build.verification import DatasetFault, DatasetVerdict, verify_dataset

__all__ = [
    "BuildConfig",
    "BuildReport",
    "BuiltSample",
    "DatasetFault",
    "DatasetVerdict",
    "build_dataset",
    "config_from_yaml",
    "load_config",
    "verify_dataset",
]
