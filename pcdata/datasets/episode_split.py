"""Which episodes are for training and which are held out."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence

import numpy as np

from pcdata.contracts.numbers import whole_number
from pcdata.errors import ConfigError
from pcdata.structures import Episode


def split_episodes(
    where: str, episodes: Sequence[Episode], parts: Mapping[str, float | int | None], seed: int
) -> dict[str, list[Episode]]:
    """Draw episodes into parts that share none.

    Raises:
        ConfigError: there are no episodes or too few, or the parts leave some out without saying so.
        DTypeError: a seed that is no whole number.
    """
    recorded = list(dict.fromkeys(episode.whole for episode in episodes))
    if not recorded:
        raise ConfigError(
            f"split_episodes: {where} has no episodes; say in episodes.json beside the captures which follow each other"
        )
    seed = whole_number("split_episodes", "seed", seed)
    counts = _counts(parts, len(recorded))
    # Sorted by a hash of each: an episode more or less moves few others from part to part.
    drawn = iter(sorted(recorded, key=lambda name: hashlib.sha256(f"{seed}\0{name}".encode()).digest()))
    found = {}
    for name, count in counts.items():
        chosen = {next(drawn) for _ in range(count)}
        found[name] = [episode for episode in episodes if episode.whole in chosen]
    return found


def _counts(parts: Mapping[str, float | int | None], total: int) -> dict[str, int]:
    told = f"of {total} episodes, got {dict(parts) if isinstance(parts, Mapping) else parts!r:.200}"
    if not isinstance(parts, Mapping) or not parts:
        raise ConfigError(f"split_episodes: parts must map names to how much {told}")
    parts = {name: part.item() if isinstance(part, np.generic) else part for name, part in parts.items()}
    counts: dict[str, int] = {}
    rest = [name for name, part in parts.items() if part is None]
    shares = 0.0
    for name, part in parts.items():
        if part is None:
            continue
        if isinstance(part, int) and not isinstance(part, bool) and part >= 1:
            counts[name] = part
        elif isinstance(part, float) and 0 < part <= 1:
            shares += part
            counts[name] = max(1, round(part * total))
        else:
            raise ConfigError(f"split_episodes: {name!r} must be a number of episodes, a share, or None, {told}")
    if len(rest) > 1 or shares > 1 + 1e-9:
        raise ConfigError(f"split_episodes: shares add up to 1 at most, and one part alone is None, the rest {told}")
    if not rest and abs(shares - 1) < 1e-9 and len(counts) == sum(isinstance(part, float) for part in parts.values()):
        rest = [max(counts, key=lambda name: counts[name])]  # rounding gives or takes one: the largest part bears it
        del counts[rest[0]]
    left = total - sum(counts.values())
    if left < len(rest):
        raise ConfigError(f"split_episodes: there are not enough episodes, every part needs one {told}")
    if left and not rest:
        raise ConfigError(
            f"split_episodes: {left} episodes would be in no part; give one part None, or name those too {told}"
        )
    return {name: counts.get(name, left) for name in parts}
