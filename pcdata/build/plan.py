"""The plan of a build: which captures, in which shards, and what decides the bytes of each."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

import pcdata
from pcdata.build.config import BuildConfig
from pcdata.build.source_state import digest_of, state_of
from pcdata.errors import CacheError
from pcdata.files.opening import replacing
from pcdata.files.strict_json import json_object
from pcdata.files.syncing import sync_file, sync_folder
from pcdata.imports import imported_files, step_names
from pcdata.io.sources.capture_source import CaptureSource, kinds_of
from pcdata.io.store.shards import shard_size_of
from pcdata.io.store.stores import STORES

SCHEMA = "pcdata.plan/1"
FILE_NAME = "plan.json"
MOST_BYTES = 1 << 20


@dataclass(frozen=True)
class Plan:
    """The captures in their order, cut into shards of one size; the last may hold fewer."""

    ids: tuple[str, ...]
    shard_size: int
    settings: Mapping[str, Any]  # what decides the bytes of every shard, in words that a refusal can compare

    @cached_property
    def identity(self) -> str:
        """SHA-256 of the settings and the ids: builds that agree in it give the same shards of the same captures."""
        return digest_of({"settings": self.settings, "ids": digest_of(self.ids), "shard_size": self.shard_size})

    @property
    def hashes_captures(self) -> bool:
        """Whether files of captures are compared by their content alone."""
        return bool(self.settings["hash_captures"])

    @property
    def num_shards(self) -> int:
        """How many shards there are."""
        return -(-len(self.ids) // self.shard_size)

    def ids_of(self, shard: int) -> tuple[str, ...]:
        """Return the ids of the captures of one shard."""
        return self.ids[shard * self.shard_size : (shard + 1) * self.shard_size]

    def to_json(self) -> dict[str, Any]:
        """Say which build it is."""
        return {
            "schema": SCHEMA,
            "identity": self.identity,
            "settings": self.settings,
            "ids": digest_of(self.ids),
            "num_samples": len(self.ids),
            "shard_size": self.shard_size,
        }

    def differences(self, where: str, content: bytes) -> list[str]:
        """Say in words how the build of another plan, as :meth:`to_json` wrote it, differs from this one.

        Raises:
            CacheError: that plan is damaged; the message begins with ``where`` it is.
        """
        there = json_object(where, content, error=CacheError)
        if there.get("identity") == self.identity:
            return []
        settings = there.get("settings")
        settings = settings if isinstance(settings, dict) else {}
        mine = json.loads(json.dumps(self.settings))
        different = [name for name in {**mine, **settings} if mine.get(name) != settings.get(name)]
        if there.get("ids") != digest_of(self.ids):
            different.append(f"captures ({there.get('num_samples')} there, {len(self.ids)} now)")
        if there.get("shard_size") != self.shard_size:
            different.append(f"shard_size ({there.get('shard_size')} there, {self.shard_size} now)")
        return different or ["schema"]


def plan_of(config: BuildConfig, source: CaptureSource, *, hash_captures: bool = False) -> Plan:
    """Return the plan for a configuration and its captures; no capture is loaded.

    ``hash_captures``: whether a large file counts as changed by its content, or by its size and time.
    """
    ids = tuple(source.ids)
    size = shard_size_of(len(ids), config.output.shard_size)
    steps = step_names(config.pipeline.split()[0].sections()) if imported_files() else set()
    kinds = {*kinds_of(source)}
    needed = [
        file.sha256
        for file in imported_files()
        if steps & {*file.transforms}
        or kinds & {*file.layouts, *file.combinators}
        or STORES[config.output.format].__module__ == file.module
    ]
    settings = {
        "steps": config.pipeline.stored_fingerprint(),
        "output": config.output.model_dump(exclude={"shard_size"}),
        "source": state_of(source),
        "hash_captures": hash_captures,
        "imports": needed,
        "versions": {"pcdata": pcdata.__version__, "torch": str(torch.__version__), "numpy": np.__version__},
    }
    return Plan(ids, size, settings)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a file of JSON whole or not at all, and force it and its name to disk.

    Raises:
        CacheError: it cannot be written.
    """
    with replacing("build", path, error=CacheError) as temporary:
        temporary.write_bytes(json_bytes(content))
        sync_file(temporary)
    sync_folder(path.parent)


def json_bytes(content: Mapping[str, Any]) -> bytes:
    """Return what a file of JSON holds; names may have bytes that are no text."""
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode("utf-8", "surrogatepass")
