"""The profiles that come with pcdata, read from profiles.yaml beside this file."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from importlib.resources import files
from types import MappingProxyType
from typing import Any

import yaml

from pcdata.errors import ConfigError, near_matches
from pcdata.sensors.noise import PolynomialNoise, StereoNoise
from pcdata.sensors.profile import SensorProfile

_NOISE: dict[str, type[StereoNoise | PolynomialNoise]] = {"stereo": StereoNoise, "polynomial": PolynomialNoise}


@functools.cache
def sensor_profiles() -> Mapping[str, SensorProfile]:
    """Return every profile by name, in the file's order."""
    text = files("pcdata.sensors").joinpath("profiles.yaml").read_text(encoding="utf-8")
    return MappingProxyType({name: _profile(name, entry) for name, entry in yaml.safe_load(text).items()})


def sensor_profile(name: str) -> SensorProfile:
    """Return the profile of this name.

    Raises:
        ConfigError: there is none; with near matches.
    """
    known = sensor_profiles()
    if name not in known:
        hint = near_matches(name, known) or f"; known: {', '.join(known)}"
        raise ConfigError(f"unknown sensor {name!r}{hint}")
    return known[name]


def _profile(name: str, entry: Mapping[str, Any]) -> SensorProfile:
    values = {"focal": None, "angular_step": None, **_frozen(entry)}
    noise = _frozen(values["noise"])
    values["noise"] = _NOISE[noise.pop("model")](**noise)
    return SensorProfile(name=name, **values)


def _frozen(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in entry.items()}
