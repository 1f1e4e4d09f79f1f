"""Which groups of samples are for training and which are held out: drawn once, and never moved again."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from pcdata.contracts.numbers import whole_number
from pcdata.errors import ConfigError
from pcdata.structures import Episode

Parts = Mapping[str, float | int | None]  # name -> how much


def split_episodes(where: str, episodes: Sequence[Episode], parts: Parts, seed: int) -> dict[str, list[Episode]]:
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
    part_of = draw_parts("split_episodes", dict.fromkeys(recorded, ""), parts, seed, noun="episodes")
    return {name: [one for one in episodes if part_of[one.whole] == name] for name in parts}


def draw_parts(
    where: str,
    strata: Mapping[str, str],
    parts: Parts,
    seed: int,
    *,
    kept: Mapping[str, str] | None = None,
    noun: str = "groups",
) -> dict[str, str]:
    """Return the part of every group.

    The groups of one stratum are taken in the order of a hash of seed and name, a run of them for each part. So the
    parts depend on the names alone, a group more or less moves few others, and with ``kept`` none at all. Every stratum
    is shared out as the whole is, up to one group or two; the whole exactly, as far as ``kept`` allows it.

    Args:
        where: who asks, the first words of a message.
        strata: group -> its stratum; one for all where nothing is to be shared out alike.
        parts: how much each part gets: a whole number of groups, a share of all (one at least), None = the rest.
        seed: of the hash.
        kept: group -> the part that it was in before, and stays in.
        noun: what the groups are, in a message.

    Raises:
        ConfigError: there are too few, or the parts leave some out without saying so.
        DTypeError: a seed that is no whole number.
    """
    seed = whole_number(where, "seed", seed)
    counts = _counts(where, parts, len(strata), noun)
    part_of = {group: kept[group] for group in strata if kept and group in kept}
    taken = Counter(part_of.values())
    most = {part: max(count, taken[part]) for part, count in counts.items()}  # kept ones may be more than a share
    seen = Counter[str]()  # of the groups so far, by part: the strata are walked through in a row
    rows: dict[str, list[str]] = {}
    for group, stratum in strata.items():
        rows.setdefault(stratum, []).append(group)
    for _, members in sorted(rows.items()):
        fresh = [group for group in members if group not in part_of]
        seen.update(part_of[group] for group in members if group in part_of)
        runs = Counter[str]()
        for total in range(seen.total() + 1, seen.total() + 1 + len(fresh)):
            open_parts = [part for part in counts if taken[part] < most[part]]
            part = max(open_parts, key=lambda part: counts[part] * total / len(strata) - seen[part])
            seen[part] += 1
            taken[part] += 1
            runs[part] += 1
        drawn = iter(sorted(fresh, key=lambda group: _place(seed, group)))
        part_of.update({next(drawn): part for part in counts for _ in range(runs[part])})
    return {group: part_of[group] for group in strata}


def _place(seed: int, group: str) -> bytes:
    # surrogatepass: file names that are not UTF-8 reach Python as lone surrogates.
    return hashlib.sha256(f"{seed}\0{group}".encode(errors="surrogatepass")).digest()


def _counts(where: str, parts: Parts, total: int, noun: str) -> dict[str, int]:
    told = f"of {total} {noun}, got {dict(parts) if isinstance(parts, Mapping) else parts!r:.200}"
    if not isinstance(parts, Mapping) or not parts:
        raise ConfigError(f"{where}: parts must map names to how much {told}")
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
            raise ConfigError(f"{where}: {name!r} must be a number of {noun}, a share, or None, {told}")
    if len(rest) > 1 or shares > 1 + 1e-9:
        raise ConfigError(f"{where}: shares add up to 1 at most, and one part alone is None, the rest {told}")
    if not rest and abs(shares - 1) < 1e-9 and len(counts) == sum(isinstance(part, float) for part in parts.values()):
        rest = [max(counts, key=lambda name: counts[name])]  # rounding gives or takes one: the largest part bears it
        del counts[rest[0]]
    left = total - sum(counts.values())
    if left < len(rest):
        raise ConfigError(
            f"{where}: there are not enough {noun} for {len(parts)} parts, {told}; name fewer parts (--parts "
            "train=1.0), or keep less together (--by sample)"
        )
    if left and not rest:
        raise ConfigError(f"{where}: {left} {noun} would be in no part; give one part None, or name those too {told}")
    return {name: counts.get(name, left) for name in parts}
