"""Stored clouds, and archives written byte by byte, for the tests of hostile files."""

from __future__ import annotations

import io
import shutil
import struct
import zlib
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pcdata import PointCloud
from pcdata.errors import CacheError, PcdataError
from pcdata.io.arrays.stored_arrays import stored_arrays
from pcdata.io.store.cloud_record import record_from_cloud
from pcdata.io.store.manifest import FILE_NAME, Manifest
from pcdata.io.store.sample_index import FOLDER, Sample
from pcdata.io.store.shards import TABLE, seal_shard, shard_folder
from pcdata.io.store.stores import STORES
from pcdata.transforms import Compose
from tests.io.memory import memory_limit


def cloud(count: int = 64) -> PointCloud:
    draw = torch.Generator().manual_seed(0)
    return PointCloud(
        points=torch.rand(count, 3, generator=draw),
        normals=torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=1),
        frame_id="base",
    )


def first_shard(folder: Path) -> Path:
    return shard_folder(folder, 0)


def write_manifest(folder: Path, form: str, samples: Sequence[Sample], **more) -> None:
    """Seal the one shard and write the manifest, both anew."""
    pipeline = more.pop("pipeline", Compose([]))
    shutil.rmtree(folder / FOLDER, ignore_errors=True)
    for path in (folder / FILE_NAME, first_shard(folder) / TABLE):
        path.unlink(missing_ok=True)
    seal_shard(first_shard(folder))
    compression = more.pop("compression", "none")
    Manifest(form, compression, pipeline.stored_fingerprint(), pipeline.sections(), samples, **more).write(folder)


def edit_samples(folder: Path, edit: Callable[[int, dict[str, Any]], dict[str, Any]]) -> None:
    """Change what the index says of samples, with hashes that fit, so that what else is checked is reached."""
    manifest = Manifest.read(folder)
    samples = [Sample(**edit(number, vars(sample).copy())) for number, sample in enumerate(manifest.samples)]
    shutil.rmtree(folder / FOLDER)
    (folder / FILE_NAME).unlink()
    replace(manifest, samples=samples).write(folder)


def stored(folder: Path, form: str, compression: str = "none") -> Path:
    store = STORES[form](folder, compression)
    store.write("a", record_from_cloud(cloud()))
    store.close()
    return store.path_of("a")


def dataset(folder: Path, form: str) -> Path:
    record = record_from_cloud(cloud())
    path = stored(first_shard(folder), form)
    write_manifest(folder, form, [Sample("a", "a", 64, record.digest())])
    return path


def refused(folder: Path, form: str, key: str = "a") -> str:
    with memory_limit(512 * 2**20), closing(STORES[form](folder)) as store, pytest.raises(CacheError) as caught:
        store.read(key)
    assert str(folder) in str(caught.value)
    assert len(str(caught.value)) < 3000
    return str(caught.value)


def foreign(path: Path, name: str = "pc") -> np.ndarray:
    with stored_arrays(path, [name]) as arrays:
        return arrays[name][...]


def foreign_refused(path: Path, name: str = "pc") -> str:
    with memory_limit(512 * 2**20), pytest.raises(PcdataError) as caught:
        foreign(path, name)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 3000
    return str(caught.value)


def zip_of(path: Path, *members: tuple[str, bytes, int, int, int], end: bytes = b"") -> Path:
    """Write members of name, stored bytes, method, claimed size and checksum, with nothing checked."""
    path.parent.mkdir(parents=True, exist_ok=True)
    local, central = b"", b""
    for name, content, method, size, crc in members:
        raw = name.encode()
        central += struct.pack(
            "<4s6H3I5H2I",
            b"PK\1\2",
            63,
            63,
            0,
            method,
            0,
            33,
            crc,
            len(content),
            size,
            len(raw),
            0,
            0,
            0,
            0,
            0,
            len(local),
        )
        central += raw
        local += struct.pack("<4s5H3I2H", b"PK\3\4", 63, 0, method, 0, 33, crc, len(content), size, len(raw), 0)
        local += raw + content
    count = len(members)
    tail = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, count, count, len(central), len(local), 0)
    path.write_bytes(local + central + tail + end)
    return path


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, allow_pickle=False)
    return stream.getvalue()


def raw_deflate(content: bytes) -> bytes:
    pack = zlib.compressobj(9, zlib.DEFLATED, -15)
    return pack.compress(content) + pack.flush()
