"""Names of files and folders for what is called by any text: the text itself where it can be one."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from pcdata.errors import CaptureError
from pcdata.files.sample_names import check_names, in_order
from pcdata.io.sources.listing import is_litter
from pcdata.io.store.sample_keys import key_of

_FORBIDDEN = {*'/\\<>:"|?*'}  # in names of files, of one system or another
_LONGEST = 200  # bytes of a name, of the 255 that a file name may have


def file_names(ids: Sequence[str], order: Callable[[Sequence[str]], list[str]] = in_order) -> list[str]:
    """Return a name for each id: different on every system, and ordered as the ids are.

    An id that no file can be called by is spelled as :func:`key_of` does; where the order would be another, or two
    could not be told apart, all names begin with their place.
    """
    names = [one if _names_files(one) else key_of(one) for one in ids]
    if len({name.casefold() for name in names}) < len(names) or not _stand_in_order(names, order):
        digits = len(str(len(ids) - 1))
        names = [f"{place:0{digits}d}_{name}" for place, name in enumerate(names)]
    return names


def _names_files(text: str) -> bool:
    """Say whether a text can be what files and folders are called, on any system."""
    return (
        bool(text)
        and text.isprintable()
        and not is_litter(text)
        and not _FORBIDDEN & {*text}
        and text == text.strip(" .")
        and len(text.encode()) <= _LONGEST
    )


def _stand_in_order(names: list[str], order: Callable[[Sequence[str]], list[str]]) -> bool:
    try:
        check_names("convert", names)
    except CaptureError:
        return False
    return order(names) == names
