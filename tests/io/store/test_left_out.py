"""The captures that a dataset lacks: few of them in dataset.json, many as arrays, which are checked when asked."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pcdata.errors import CacheError
from pcdata.files.npy import npy_bytes
from pcdata.io.store import manifest as manifest_of
from pcdata.io.store.manifest import FILE_NAME, MOST_IN_JSON, Manifest, checksum_of
from pcdata.io.store.sample_index import Sample
from pcdata.io.store.shards import seal_shard, shard_folder

GOOD = {"format": "npz", "compression": "none", "fingerprint": "f" * 64, "pipeline": {}}
MANY = {f"ä/{number}": f"OSError: bad sector {number}" for number in range(MOST_IN_JSON + 1)}
FEW = dict(list(MANY.items())[:-1])


def written(folder, **fields):
    seal_shard(shard_folder(folder, 0))
    Manifest(**GOOD, samples=[Sample("a", "a", 3, "d" * 64)], **fields).write(folder)
    return Manifest.read(folder)


@pytest.mark.parametrize("kind", ["quarantined", "skipped"])
@pytest.mark.parametrize("left", [{}, FEW, MANY], ids=["none", "few", "many"])
def test_what_was_left_out_is_read_back_however_much_it_is(tmp_path, kind, left):
    found = getattr(written(tmp_path, **{kind: left}), kind)
    assert len(found) == len(left)
    assert dict(found.items()) == left == dict(found)
    assert [*found.values()] == [*left.values()]
    assert "x" not in found
    for name in list(left)[:3]:
        assert found[name] == left[name]
    assert len(list((tmp_path / "index").glob(f"{kind}_*"))) == (4 if left is MANY else 0)


def test_dataset_json_stays_small_and_nothing_is_looked_at_before_it_is_asked(tmp_path):
    written(tmp_path, quarantined=MANY)
    assert (tmp_path / FILE_NAME).stat().st_size < 5000
    (tmp_path / "index" / "quarantined_ids.npy").unlink()
    manifest = Manifest.read(tmp_path)
    assert len(manifest.quarantined) == len(MANY)
    with pytest.raises(CacheError, match=r"index/quarantined_ids\.npy is missing"):
        list(manifest.quarantined)


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("ids", np.zeros(4, np.uint8)),
        ("id_ends", np.full(MOST_IN_JSON + 1, 1 << 60)),
        ("id_ends", np.arange(MOST_IN_JSON + 1, 0, -1)),
        ("id_ends", np.zeros(MOST_IN_JSON + 1, np.int64)),
        ("reason_ends", np.arange(1, 5)),
        ("reason_ends", np.ones((MOST_IN_JSON + 1, 1), np.int64)),
        ("reasons", np.zeros(9, np.float32)),
    ],
    ids=str,
)
@pytest.mark.parametrize("is_told", [False, True], ids=["changed", "forged"])
def test_hostile_arrays_are_refused(tmp_path, name, array, is_told):
    import hashlib

    written(tmp_path, quarantined=MANY)
    content = npy_bytes(array)
    (tmp_path / "index" / f"quarantined_{name}.npy").write_bytes(content)
    if is_told:
        told = json.loads((tmp_path / FILE_NAME).read_text())
        told.pop("checksum")
        told["quarantined"][name] = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        (tmp_path / FILE_NAME).write_text(json.dumps({**told, "checksum": checksum_of(told)}))
    with pytest.raises(CacheError):
        dict(Manifest.read(tmp_path).quarantined.items())


@pytest.mark.parametrize("told", [[], 3, {"a": 1}, {"num_captures": True}, {"num_captures": 1, "ids": {}}], ids=str)
def test_a_hostile_account_is_refused(tmp_path, told):
    written(tmp_path)
    content = json.loads((tmp_path / FILE_NAME).read_text())
    content.pop("checksum")
    content["quarantined"] = told
    (tmp_path / FILE_NAME).write_text(json.dumps({**content, "checksum": checksum_of(content)}))
    with pytest.raises(CacheError, match="quarantined"):
        Manifest.read(tmp_path)


def test_a_dataset_json_that_could_not_be_read_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr(manifest_of, "_MAX_BYTES", 10_000)
    with pytest.raises(CacheError, match="most of them its streams, and at most 10,000 are read"):
        written(tmp_path, streams=[{"name": "x" * 100}] * 100)
    assert not (tmp_path / FILE_NAME).exists()
