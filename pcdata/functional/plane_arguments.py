"""What a search for planes is asked for: seeds, a direction and an angle from it, a probability, a guess."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from pcdata.contracts.numbers import checked_fraction
from pcdata.errors import ConfigError, DTypeError, ShapeError


def checked_seeds(where: str, name: str, arguments: Mapping[str, Any]) -> list[int]:
    """Require one seed for every cloud, or one per cloud (B,); bodies get a list of B."""
    seed, num_clouds = arguments[name], arguments["ptr"].shape[0] - 1
    given = seed.tolist() if isinstance(seed, Tensor) else seed
    seeds = list(given) if isinstance(given, Sequence) else [given] * num_clouds
    if not all(isinstance(one, int) and not isinstance(one, bool) for one in seeds):
        raise DTypeError(f"{where}: seed must be an int, or a sequence or tensor of ints, got {given}")
    if len(seeds) != num_clouds:
        raise ShapeError(f"{where}: {len(seeds)} seeds were given for {num_clouds} clouds")
    return seeds


def checked_up(where: str, name: str, arguments: Mapping[str, Any]) -> Tensor:
    """Require one direction for every cloud, or one per cloud; bodies get (B, 3) float64 unit vectors on the CPU."""
    num_clouds = arguments["ptr"].shape[0] - 1
    directions = torch.as_tensor(arguments[name], dtype=torch.float64, device="cpu").detach()
    if directions.shape == (3,):
        directions = directions.expand(num_clouds, 3)
    if directions.shape != (num_clouds, 3):
        raise ShapeError(f"{where}: up must be (3,) or ({num_clouds}, 3), got {tuple(directions.shape)}")
    lengths = directions.norm(dim=1)
    if not bool((torch.isfinite(lengths) & (lengths > 0)).all()):
        raise ConfigError(f"{where}: up must be finite and not zero")
    return directions / lengths[:, None]


def checked_tilt(where: str, name: str, arguments: Mapping[str, Any]) -> float:
    """Require an angle from up."""
    tilt: float = arguments[name]
    if arguments["up"] is None:
        raise ConfigError(f"{where}: max_tilt is an angle from up, but up was not given; pass up=(0, 0, 1) or the like")
    if not 0 <= tilt <= math.pi:
        raise ConfigError(f"{where}: max_tilt is in radians, between 0 and pi, got {tilt}")
    return tilt


def checked_probability(where: str, name: str, arguments: Mapping[str, Any]) -> float:
    """Require a number between 0 and 1."""
    value = checked_fraction(where, name, arguments)
    if value == 1:
        raise ConfigError(f"{where}: probability must be less than 1, which no number of tries gives; leave it out")
    return value


def checked_guess(where: str, name: str, arguments: Mapping[str, Any]) -> Tensor:
    """Require one plane per cloud; bodies get (B, 4) float64 on the CPU with unit normals, NaN where there is none."""
    planes = torch.as_tensor(arguments[name], dtype=torch.float64, device="cpu").detach()
    if planes.shape != (arguments["ptr"].shape[0] - 1, 4):
        raise ShapeError(f"{where}: guess must be ({len(arguments['ptr']) - 1}, 4), got {tuple(planes.shape)}")
    planes = planes / planes[:, :3].norm(dim=1, keepdim=True)
    return planes.masked_fill(~planes.isfinite().all(1, keepdim=True), torch.nan)
