"""dataset.json: keys that are safe file names, and nothing hostile or damaged gets through."""

from __future__ import annotations

import json
import pickle
import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pcdata.errors import CacheError, PcdataWarning
from pcdata.io.store.manifest import FILE_NAME, SCHEMA, Manifest, checksum_of
from pcdata.io.store.sample_index import Sample
from pcdata.io.store.sample_keys import key_of
from pcdata.io.store.shards import seal_shard, shard_folder

GOOD = {
    "format": "npz",
    "compression": "none",
    "fingerprint": "f" * 64,
    "pipeline": {"depth": [], "cloud": [], "augment": []},
    "versions": {"pcdata": "0.1.0"},
    "schema": SCHEMA,
}
SAMPLE = Sample("a", "a", 3, "d" * 64)


@pytest.fixture(autouse=True)
def _index(tmp_path):
    """Let the example of these tests have an index."""
    seal_shard(shard_folder(tmp_path, 0))
    Manifest(**GOOD, samples=[SAMPLE]).write(tmp_path)
    content = json.loads((tmp_path / FILE_NAME).read_text())
    GOOD.update({name: content[name] for name in ("index", "num_samples")})
    yield
    for name in ("index", "num_samples"):
        del GOOD[name]


def _refused(folder: Path, content: object) -> str:
    text = content if isinstance(content, (str, bytes)) else json.dumps(content)
    (folder / FILE_NAME).write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(CacheError) as caught:
        Manifest.read(folder)
    assert str(folder / FILE_NAME) in str(caught.value)
    return str(caught.value)


def test_what_is_written_is_read(tmp_path):
    ids = ["a/b", "ü", "..", "x" * 300, "a b"]
    samples = [Sample(name, key_of(name), number, "d" * 64, number // 2) for number, name in enumerate(ids)]
    manifest = Manifest("hdf5", "lzf", "f" * 64, {"depth": [], "cloud": []}, samples, versions={"torch": "2"})
    folder = tmp_path / "new"
    for shard in range(3):
        seal_shard(shard_folder(folder, shard))
    manifest.write(folder)
    for read in (Manifest.read(folder), Manifest.read(str(folder)), pickle.loads(pickle.dumps(Manifest.read(folder)))):
        assert read == manifest
        assert read.samples == samples
        assert read.index.ids == ids
        assert [read.index.ids.place_of(name) for name in (*ids, "", "c", 5)] == [0, 1, 2, 3, 4, None, None, None]
        assert [read.index.of_shard(shard) for shard in range(3)] == [range(2), range(2, 4), range(4, 5)]


def test_the_example_of_these_tests_is_valid(tmp_path):
    (tmp_path / FILE_NAME).write_text(json.dumps({**GOOD, "checksum": checksum_of(GOOD)}))
    assert Manifest.read(tmp_path).samples == [SAMPLE]


@pytest.mark.parametrize(
    "change",
    [
        {"num_samples": 2},
        {"index": {}},
        {"fingerprint": "0" * 64},
        {"pipeline": {"depth": [], "cloud": [], "augment": [{"RandomYaw": {}}]}},
        {"versions": {"pcdata": "0.1.1"}},
    ],
    ids=str,
)
def test_an_edit_that_is_valid_in_itself_is_noticed(tmp_path, change):
    assert "was changed after it was written" in _refused(tmp_path, {**GOOD, **change, "checksum": checksum_of(GOOD)})


def test_one_without_a_checksum_says_that_edits_cannot_be_told(tmp_path):
    (tmp_path / FILE_NAME).write_text(json.dumps(GOOD))
    with pytest.warns(PcdataWarning, match=r"no checksum.*rebuild"):
        Manifest.read(tmp_path)


def test_json_that_takes_far_more_memory_than_its_text_is_refused(tmp_path):
    assert "hostile" in _refused(tmp_path, b'{"a":[' + b"[]," * 1_000_000 + b"[]]}")


LINES = "\n\r\v\f\x1c\x1d\x1e\x85\u2028\u2029"  # what ends a line
LETTERS = st.characters(exclude_categories=["Cs"], exclude_characters=LINES)


@given(st.text(LETTERS, min_size=1), st.text(LETTERS, min_size=1))
def test_keys_are_safe_file_names_and_differ_when_ids_differ(one, other):
    for sample_id in (one, other):
        key = key_of(sample_id)
        assert re.fullmatch(r"[A-Za-z0-9_.%~-]{1,200}", key)
        assert not key.startswith(".")
    assert (key_of(one) == key_of(other)) == (one == other)


@given(st.text(LETTERS, min_size=150, max_size=400), st.text(LETTERS, min_size=1, max_size=3))
def test_long_ids_that_differ_at_the_end_alone_have_different_keys(stem, end):
    assert key_of(stem) != key_of(stem + end)
    assert len(key_of(stem + end)) <= 200


@pytest.mark.parametrize("end", LINES)
def test_an_id_is_one_line(end):
    for sample_id in (f"a{end}b", f"a{end}", end):
        with pytest.raises(CacheError, match="one line"):
            key_of(sample_id)


@pytest.mark.parametrize("sample_id", ["scene_0001", "a.b-C_9"])
def test_plain_ids_are_their_own_key(sample_id):
    assert key_of(sample_id) == sample_id


@pytest.mark.parametrize("sample_id", ["", None, 5])
def test_an_id_that_is_no_text_has_no_key(sample_id):
    with pytest.raises(CacheError, match="sample id"):
        key_of(sample_id)


def test_a_name_that_is_not_utf8_has_a_key():
    assert key_of(b"scan-\xe9".decode("utf-8", "surrogateescape")) != key_of("scan-é")


@pytest.mark.parametrize("key", ["../x", "..", "/etc/passwd", "a/b", "A", "", "a\0", "a.npz/../../x"])
def test_a_key_that_is_not_that_of_its_id_is_refused(key):
    with pytest.raises(CacheError, match="must have the key 'a'"):
        Manifest(
            **{name: GOOD[name] for name in ("format", "compression", "fingerprint", "pipeline")},
            samples=[replace(SAMPLE, key=key)],
        )


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"schema": "pcdata.dataset/999"}, "rebuild"),
        ({"schema": None}, "schema"),
        ({"streams": [3]}, "streams"),
        ({"format": "parquet"}, "hdf5, npz, packed, pt"),
        ({"format": ["npz"]}, ""),
        ({"format": None}, "format"),
        ({"compression": "zstd"}, "compression"),
        ({"compression": "lzf"}, "compression"),  # npz has none
        ({"fingerprint": 5}, "fingerprint"),
        ({"pipeline": []}, "pipeline"),
        ({"pipeline": None}, "pipeline"),
        ({"versions": "1.0"}, "versions"),
        ({"num_samples": 2}, "num_samples"),
        ({"num_samples": True}, "num_samples"),
        ({"num_samples": 10**30}, "num_samples"),
        ({"index": None}, "index must tell"),
        ({"index": {"../../ids.npy": {"bytes": 1, "sha256": ""}}}, "index must tell"),
        ({"samples": []}, "samples"),
        ({"keep_raw": 1}, "keep_raw"),
        ({"shard_size": 0}, "shard_size"),
        ({"surprise": 1}, "surprise"),
    ],
    ids=str,
)
def test_wrong_contents_are_refused(tmp_path, change, word):
    assert word in _refused(tmp_path, {**GOOD, **change})


@pytest.mark.parametrize("name", ["index", "num_samples", *(name for name in GOOD if name != "versions")])
def test_a_missing_entry_is_refused(tmp_path, name):
    _refused(tmp_path, {key: value for key, value in GOOD.items() if key != name})


@pytest.mark.parametrize(
    "content", ["", "no json", "[]", "null", "[" * 200_000, '{"a":' * 200_000, b"\xff\xfe\x00", b"\0" * 99, "1" * 5000]
)
def test_text_that_is_no_json_object_is_refused(tmp_path, content):
    _refused(tmp_path, content)


def test_a_cut_file_is_refused_wherever_it_is_cut(tmp_path):
    text = json.dumps(GOOD)
    for cut in range(0, len(text) - 1, 7):
        _refused(tmp_path, text[:cut])


def test_a_folder_without_one_says_how_to_make_one(tmp_path):
    (tmp_path / FILE_NAME).unlink()
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(CacheError, match="pcdata build"):
            Manifest.read(folder)
    (tmp_path / FILE_NAME).mkdir()
    with pytest.raises(CacheError, match="pcdata build"):
        Manifest.read(tmp_path)


def test_an_absurdly_large_file_is_refused_unread(tmp_path):
    with open(tmp_path / FILE_NAME, "wb") as file:
        file.truncate(2**40)  # sparse: reading it would never end
    with pytest.raises(CacheError, match="more than the limit"):
        Manifest.read(tmp_path)


@pytest.mark.parametrize(
    "episodes",
    [
        3,
        [{"id": "a"}],
        [{"id": "a", "first": 0, "length": 9, "times": [], "attributes": {}}],
        [{"id": "a", "first": -1, "length": 1, "times": [], "attributes": {}}],
        [{"id": "a", "first": 0, "length": 1, "times": [], "attributes": {}}] * 2,
    ],
)
def test_what_is_wrong_with_episodes_is_told_without_a_word_twice(tmp_path, episodes):
    told = _refused(tmp_path, {**GOOD, "episodes": episodes})
    assert not re.search(r"\b(\w[\w ]*): \1:", told), told
