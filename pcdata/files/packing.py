"""How much may come out of packed bytes: the bound on memory that every reader of packed arrays shares."""

from __future__ import annotations

from pcdata.errors import CacheError

MAX_PACKING = 100  # measured numbers pack a few to one; zeros pack a thousand to one and could fill the memory
ALWAYS = 1 << 28  # bytes that may be unpacked however small the file is: a cloud that is all padding


def check_packing(what: str, claimed: int, stored: int) -> None:
    """Require that ``stored`` bytes unpack to no more than 100 times as many, or 256 MiB.

    Raises:
        CacheError: they claim more.
    """
    if claimed > max(ALWAYS, MAX_PACKING * stored):
        raise CacheError(
            f"{what} claims {claimed} bytes, stored in {stored}; measured numbers pack at most {MAX_PACKING} to 1, so "
            "its header is damaged or it would fill the memory; write it again, uncompressed if it is meant"
        )
