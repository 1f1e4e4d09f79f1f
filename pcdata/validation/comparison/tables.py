"""Every number of both sources beside each other, with a verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping

from pcdata.validation.comparison.description import Key, Series
from pcdata.validation.comparison.quantities import quantity_of
from pcdata.validation.comparison.result import Measured
from pcdata.validation.comparison.statistics import ALPHA, Tested, compared, significant
from pcdata.verdicts import Verdict

Table = Mapping[Key, Measured]

_EXACT = ("fov_x", "fov_y", "center_x", "center_y")  # of the file, not of a scene: one capture tells them


def table_of(a: Series, b: Series, keys: list[Key]) -> Table:
    """Test every number, all of them together."""
    found = [compared(a.values(*key), b.values(*key)) for key in keys]
    found = [_certain(one) if _is_exact(key) else one for key, one in zip(keys, found)]
    more = significant([one.p for one in found])
    alpha = ALPHA / max(len(keys), 1)
    return {key: _measured(key, one, sure, alpha) for key, one, sure in zip(keys, found, more)}


def _is_exact(key: Key) -> bool:
    return key[0] in _EXACT or (key[0] == "density" and key[1] is not None)


def _certain(one: Tested) -> Tested:
    return Tested(one.a, one.b, 0.0, 1.0, float(one.a == one.b)) if math.isnan(one.p) else one


def _measured(key: Key, one: Tested, sure: bool, alpha: float) -> Measured:
    row = quantity_of(key[0])
    passes, fails = row.allowed(one.a, one.b) or (math.inf, math.inf)
    off = abs(one.b - one.a)
    if math.isnan(one.p):
        verdict = Verdict.UNKNOWN
    elif not sure or off <= passes:
        verdict = Verdict.PASS
    else:
        verdict = Verdict.WARN if off <= fails else Verdict.FAIL
    return Measured(
        name=key[0],
        view=key[1],
        family=row.family,
        a=one.a,
        b=one.b,
        passes=passes,
        fails_beyond=fails,
        seen_from=one.seen_from(alpha),
        chance=one.p,
        verdict=verdict,
        left=verdict,
    )


def bad(table: Table) -> set[Key]:
    """Return what differs."""
    return {key for key, one in table.items() if one.differs}


def bad_families(table: Table) -> set[str]:
    """Return the families of what differs."""
    return {table[key].family for key in bad(table)}
