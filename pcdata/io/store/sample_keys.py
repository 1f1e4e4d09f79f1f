"""Keys: what a sample is called in the file system, made from its id."""

from __future__ import annotations

import hashlib
import re
from urllib.parse import quote

import numpy as np

from pcdata.errors import CacheError
from pcdata.io.store.text_table import TextTable

_MAX_KEY = 200  # file names end at 255 bytes
_PLAIN = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,199}")
_IS_PLAIN = np.array([_PLAIN.fullmatch(f"a{chr(byte)}") is not None for byte in range(256)])


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


def keys_of(ids: TextTable) -> TextTable:
    """Return the keys of many sample ids."""
    if not len(ids):
        return ids
    begins = np.concatenate([np.zeros(1, np.int64), ids.ends[:-1]])
    is_short = (ids.ends - begins <= _MAX_KEY).all()
    if is_short and _IS_PLAIN[ids.letters].all() and not (ids.letters[begins] == ord(".")).any():
        return ids
    return TextTable.of(map(key_of, ids))
