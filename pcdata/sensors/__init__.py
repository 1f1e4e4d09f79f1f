"""Depth sensors as data: what each measures, how far, how finely and how noisily, with the source of every figure."""

from pcdata.sensors.known_sensors import sensor_profile, sensor_profiles
from pcdata.sensors.noise import PolynomialNoise, StereoNoise
from pcdata.sensors.profile import SensorProfile

__all__ = ["PolynomialNoise", "SensorProfile", "StereoNoise", "sensor_profile", "sensor_profiles"]
