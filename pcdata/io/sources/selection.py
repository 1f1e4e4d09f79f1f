"""Captures that are left out: listed by their ids, or refused when they are read. Never without a word."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from pcdata.errors import CaptureError
from pcdata.files.opening import read_text
from pcdata.io.sources.detect import open_source
from pcdata.io.sources.source import Source, refused_captures


def open_selected(
    path: str | os.PathLike[str],
    *,
    kind: str | None = None,
    limit: int | None = None,
    skip: Sequence[str] = (),
    skip_refused: bool = False,
    **options: Any,
) -> Source:
    """Open a capture without some of its samples; ``skipped`` of what is returned tells which, and why.

    Args:
        path: as for :func:`pcdata.open_source`.
        kind: as for :func:`pcdata.open_source`.
        limit: keep the first so many of the samples that are not listed.
        skip: ids to leave out.
        skip_refused: load every capture once, and leave out those that are refused.
        **options: those of the layout's class.

    Raises:
        CaptureError: as :func:`pcdata.open_source`; a listed id is not there, or nothing is left.
        ConfigError: as :func:`pcdata.open_source`.
    """
    source = open_source(path, kind=kind, limit=None if skip else limit, **options)
    if skip:
        source = source.without(skip)
        source = source if limit is None else source.subset(source.ids[:limit])
    if skip_refused and (refused := refused_captures(source)):
        source = source.without(refused)
    return source


def read_skip_file(path: str | os.PathLike[str]) -> list[str]:
    """Read a list of sample ids, one on a line; empty lines and those that begin with ``#`` do not count.

    Raises:
        CaptureError: the file is missing or no text, or lists no id, which is more likely a mistake than meant.
    """
    lines = (line.strip() for line in read_text("read_skip_file", path).splitlines())
    listed = [line for line in lines if line and not line.startswith("#")]
    if not listed:
        raise CaptureError(f"read_skip_file: {path}: lists no id; give one on a line, or leave the file out")
    return listed
