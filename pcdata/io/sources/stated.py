"""What a capture says of itself and what an argument says of it: one value, or an error that names both."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pcdata.contracts.lengths import check_metres_per_unit
from pcdata.errors import CaptureError, PcdataError, UnitError
from pcdata.files.opening import check_inside
from pcdata.io.calibration.calibration_yaml import read_calibration
from pcdata.io.sources.listing import absolute
from pcdata.structures import Calibration

Value = TypeVar("Value")
_WAY = "correct the file if it is wrong, else leave the argument out"


def one_value(
    file: Path, option: str, stated: Value | None, given: Value | None, *, error: type[PcdataError] = CaptureError
) -> Value | None:
    """Return what the file or the argument says; None = neither does.

    Raises:
        CaptureError: they contradict each other; or another error that is asked for.
    """
    if stated is not None and given is not None and stated != given:
        raise error(f"{file}: says {option} {stated!r}, the argument {given!r}; {_WAY}")
    return stated if given is None else given


def one_unit(file: Path, stated: float | None, given: float | None) -> float:
    """Return the length of one stored depth unit.

    Raises:
        UnitError: nobody says it, it is none, or two say it differently.
    """
    unit = one_value(file, "metres_per_unit", stated, given, error=UnitError)
    if unit is None:
        raise UnitError(
            f'{file}: the unit of depth must be stated: add "metres_per_unit" to the file, 0.001 for millimetres, 1 '
            "for metres, as floats mostly are; or pass it (--metres-per-unit M)"
        )
    return check_metres_per_unit(str(file), unit)


def one_calibration(
    file: Path,
    stated: str | None,  # the name of a file beside it
    given: Calibration | str | os.PathLike[str] | None,
    allowed: list[Path],  # where links may lead to
) -> Calibration | Path | None:
    """Return the calibration that replaces the camera of the capture.

    Raises:
        CaptureError: two are given, or that of the capture lies outside of it.
    """
    if stated is None:
        return given if given is None or isinstance(given, Calibration) else Path(given)
    own = file.parent / stated
    if given is not None and (isinstance(given, Calibration) or absolute(given) != own):
        told = "an object" if isinstance(given, Calibration) else repr(os.fspath(given))
        raise CaptureError(f"{file}: says calibration {stated!r}, the argument {told}; {_WAY}")
    check_inside(str(file.parent), own, allowed)
    return own


def opened_calibration(calibration: Calibration | str | os.PathLike[str]) -> tuple[Calibration, str]:
    """Return a calibration, read where a file is given, and what provenance tells of its origin."""
    if isinstance(calibration, Calibration):
        return calibration, "given as an object"
    return read_calibration(calibration), Path(os.fspath(calibration)).name


def one_naming(
    file: Path, stated: Mapping[str, str | None] | None, given: Mapping[str, str | None] | None
) -> dict[str, Any] | None:
    """Return the names of folders by role that the file and the argument say together.

    Raises:
        CaptureError: they name one role differently.
    """
    if stated is None or given is None or not isinstance(given, Mapping):
        return stated if given is None else given  # type: ignore[return-value]
    for role in stated.keys() & given.keys():
        if stated[role] != given[role]:
            raise CaptureError(f"{file}: says folders {role} {stated[role]!r}, the argument {given[role]!r}; {_WAY}")
    return {**stated, **given}
