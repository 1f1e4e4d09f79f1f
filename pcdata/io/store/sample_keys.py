"""Keys: what a sample is called in the file system, made from its id."""

from __future__ import annotations

import hashlib
import re
from urllib.parse import quote

from pcdata.errors import CacheError

_MAX_KEY = 200  # file names end at 255 bytes
_PLAIN = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,199}")


def key_of(sample_id: str) -> str:
    """Return a file-name safe and unique key for a sample id.

    Letters, digits, dot, dash and underscore stay; other bytes become %XX; a leading dot too. A key too long for a file
    name ends in ``~`` and a hash instead.

    Raises:
        CacheError: the id is empty, or no text in one line.
    """
    if isinstance(sample_id, str) and _PLAIN.fullmatch(sample_id):  # most are, and each is asked for in every epoch
        return sample_id
    if not isinstance(sample_id, str) or sample_id.splitlines() != [sample_id]:
        raise CacheError(f"a sample id must be a text in one line that is not empty, got {sample_id!r:.100}")
    # surrogatepass: file names that are not UTF-8 reach Python as lone surrogates.
    key = quote(sample_id, safe="", errors="surrogatepass").replace("~", "%7E")
    key = "%2E" + key[1:] if key.startswith(".") else key
    if len(key) > _MAX_KEY:
        digest = hashlib.sha256(key.encode()).hexdigest()[:32]
        key = f"{key[: _MAX_KEY - 33]}~{digest}"
    return key
