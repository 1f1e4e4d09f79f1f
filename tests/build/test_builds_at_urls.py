"""Builds at a URL: the bytes of a folder's build, whoever does which part, whatever fails on the way."""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
import time
import urllib.request
from contextlib import suppress
from pathlib import Path

import fsspec
import pytest
import torch
from torch.utils.data import DataLoader

from pcdata import CachedCloudDataset, StreamedCloudDataset, collate_packed
from pcdata.build import build_dataset, outlook
from pcdata.build.building_url import BuildingUrl
from pcdata.build.placing_at_url import PlacingAtUrl
from pcdata.build.verification import verify_dataset
from pcdata.errors import CacheError, ConfigError
from pcdata.files import urls
from pcdata.files.url_writing import WritableUrl
from tests.build.test_builder import FORMATS
from tests.build.test_builder import tree as tree_of
from tests.build.test_resumed_builds import Counted, config_of, same_state  # noqa: F401

HAS_S3 = all(map(importlib.util.find_spec, ("s3fs", "moto", "flask")))
IN_MEMORY = pytest.mark.parametrize("url", ["memory"], indirect=True)
AWS = {"AWS_ACCESS_KEY_ID": "none", "AWS_SECRET_ACCESS_KEY": "none", "AWS_DEFAULT_REGION": "us-east-1"}


@pytest.fixture(scope="session")
def s3():
    """The address of a server of S3 on this machine."""
    if not HAS_S3:
        pytest.skip('needs s3fs and "moto[server]"')
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    code = f"from moto.server import main; main(['-p', '{port}', '-H', '127.0.0.1'])"
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    server = subprocess.Popen([sys.executable, "-c", code], **silent)
    try:
        for _ in range(600):
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/moto-api/", timeout=1).close()
                break
            except OSError:
                time.sleep(0.1)
        yield f"http://127.0.0.1:{port}"
    finally:
        server.kill()
        server.wait()


@pytest.fixture(params=["memory", "s3"])
def url(request, tmp_path, monkeypatch) -> str:
    """Where a dataset goes, on each kind of file system."""
    monkeypatch.setattr(urls, "_FIRST_WAIT", 0.0)
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)  # takes most of the time, on a slow disk
    monkeypatch.setenv("TMPDIR", str(tmp_path / "scratch"))
    monkeypatch.setattr("tempfile.tempdir", None)
    (tmp_path / "scratch").mkdir()
    if request.param != "s3":
        return f"{request.param}://{tmp_path}/bucket/set"
    for name, value in AWS.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("AWS_ENDPOINT_URL", request.getfixturevalue("s3"))
    bucket = f"b{time.time_ns()}"
    fsspec.filesystem("s3").mkdir(bucket)
    return f"s3://{bucket}/deep/set"


def build(out, form="npz", source=None, **how):
    return build_dataset(config_of(form), source or Counted(), out, **how)


def objects(url: str) -> dict[str, bytes]:
    """The files below a URL, and the names of those beside it."""
    files, root = fsspec.core.url_to_fs(url)
    files.invalidate_cache()
    root = root.strip("/")
    found = {name.strip("/"): name for name in files.find(root if files.async_impl else f"/{root}")}
    return {name[len(root) + 1 :]: files.cat_file(real) for name, real in found.items()}


def tree(folder: Path) -> dict[str, bytes]:
    return {name: content for name, content in tree_of(folder).items() if content is not None}


def beside(url: str) -> set[str]:
    return {name.split("/")[0] for name in objects(url.rpartition("/")[0])}


def plain(tmp_path: Path, form: str = "npz", source=None) -> dict[str, bytes]:
    """What a build in a folder gives."""
    folder = tmp_path / "plain"
    if not folder.exists():
        build(folder, form, source)
    return tree(folder)


# -- the same bytes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("url", "form"), [*(("memory", form) for form in FORMATS), ("local", "npz"), ("s3", "hdf5")], indirect=["url"]
)
def test_a_build_at_a_url_has_the_bytes_of_one_in_a_folder(url, tmp_path, form):
    wanted = plain(tmp_path, form)
    report = build(url, form)
    assert (report.folder, report.is_complete) == (url, True)
    assert objects(url) == wanted
    assert beside(url) == {"set"}
    assert os.listdir(tmp_path / "scratch") == []


def test_what_was_built_at_a_url_is_read_where_it_is(url, tmp_path):
    build(url, "webdataset")
    build(tmp_path / "plain", "webdataset")
    there, plain = CachedCloudDataset(url, seed=3), CachedCloudDataset(tmp_path / "plain", seed=3)
    assert there.manifest.identity == outlook(config_of("webdataset"), Counted(), url).identity
    # The datasets are read in this process before their copies, which come by fork, read too.
    for workers in (0, 2):
        how = {"num_workers": workers, "multiprocessing_context": "fork" if workers else None}
        for make in (
            lambda data, how: DataLoader(data, batch_size=4, collate_fn=collate_packed, **how),
            lambda data, how: DataLoader(
                StreamedCloudDataset(data, batch_size=4), batch_size=None, collate_fn=collate_packed, **how
            ),
        ):
            read, wanted = [*make(there, how)], [*make(plain, how)]
            assert sum(batch.num_clouds for batch in wanted) == 11
            assert [batch.num_clouds for batch in read] == [batch.num_clouds for batch in wanted]
            assert all(torch.equal(one.points, other.points) for one, other in zip(read, wanted))


def test_another_format_at_a_url_is_refused_at_once_and_read_from_a_copy_as_the_message_says(url, tmp_path):
    build(url, "hdf5")
    with pytest.raises(CacheError, match=r"format hdf5 is read from folders alone: copy the dataset to one, or build"):
        CachedCloudDataset(url)
    for name, content in objects(url).items():
        path = tmp_path / "copy" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    assert verify_dataset(tmp_path / "copy").faults == []
    assert [cloud.num_points for cloud in CachedCloudDataset(tmp_path / "copy")] == [*range(20, 31)]


@pytest.mark.parametrize("url", ["s3"], indirect=True)
def test_a_missing_bucket_is_told(url):
    with pytest.raises(CacheError, match=r"there is no such bucket; check the URL, or make one"):
        build("s3://nobody-has-made-this/set")


def test_a_file_url_is_a_folder(tmp_path):
    wanted = plain(tmp_path)
    report = build(f"file://{tmp_path}/a%20set")
    assert report.folder == tmp_path / "a set"
    assert tree(tmp_path / "a set") == wanted


def test_a_build_that_was_stopped_goes_on_from_what_is_at_the_url(url, tmp_path):
    wanted = plain(tmp_path)
    for stop in ("c01", "c02", "c07", "c10"):
        with pytest.raises(KeyboardInterrupt):
            build(url, source=Counted(stop_at=stop))
        assert "set" not in beside(url)
    source = Counted()
    report = build(url, source=source)
    assert source.loaded == ["c10"]
    assert "5 of 6 shards were finished before" in report.notes
    assert objects(url) == wanted
    assert beside(url) == {"set"}


def test_parts_meet_at_the_url_and_the_last_one_puts_it_into_place(url, tmp_path):
    wanted = plain(tmp_path)
    reports = [build(url, part=(k, 3)) for k in (2, 0)]
    assert [report.is_complete for report in reports] == [False, False]
    with pytest.raises(CacheError, match="2 of 6 shards are not finished"):
        build(url, finalize=True)
    assert outlook(config_of(), Counted(), url).num_finished == 4
    assert build(url, part=(1, 3)).is_complete
    assert objects(url) == wanted
    assert beside(url) == {"set"}


def test_finalize_puts_into_place_what_parts_have_finished(url, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(BuildingUrl, "put_into_place", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            build(url)
    assert build(url, finalize=True).is_complete
    assert objects(url) == plain(tmp_path)


# -- what is there already ------------------------------------------------------------------------------------------


def test_what_is_there_is_replaced_only_when_asked_and_only_if_it_is_a_dataset_alone(url, tmp_path):
    build(url, source=Counted(14))
    before = objects(url)
    with pytest.raises(CacheError, match=r"exists already.*--overwrite"):
        build(url)
    assert outlook(config_of(), Counted(), url).hindrances == ["a dataset is there; --overwrite replaces it"]
    files, root = fsspec.core.url_to_fs(url)
    files.pipe_file(f"{root}/mine.txt", b"notes")
    with pytest.raises(CacheError, match=r"also holds mine.txt"):
        build(url, overwrite=True)
    files.rm_file(f"{root}/mine.txt")
    assert objects(url) == before
    assert build(url, overwrite=True).is_complete
    assert objects(url) == plain(tmp_path)


def test_what_is_no_dataset_is_never_replaced(url):
    files, root = fsspec.core.url_to_fs(url)
    if not files.async_impl:
        files.makedirs(root)
    files.pipe_file(f"{root}/mine.txt", b"notes")
    with pytest.raises(CacheError, match="is not a pcdata dataset"):
        build(url, overwrite=True)
    assert objects(url) == {"mine.txt": b"notes"}


def test_the_old_dataset_is_whole_until_the_new_one_is_and_splits_are_kept(url, tmp_path):
    for place in (url, tmp_path / "plain"):
        build(place)
    old = objects(url)
    for name in ("card.yaml", "splits.json"):
        assert name not in old
    files, root = fsspec.core.url_to_fs(url)
    files.pipe_file(f"{root}/card.yaml", b"license: cc-by-4.0\n")
    (tmp_path / "plain" / "card.yaml").write_bytes(b"license: cc-by-4.0\n")
    with pytest.raises(KeyboardInterrupt):
        build(url, source=Counted(14, stop_at="c13"), overwrite=True)
    assert objects(url) == {**old, "card.yaml": b"license: cc-by-4.0\n"}
    build(url, source=Counted(14), overwrite=True)
    build(tmp_path / "plain", source=Counted(14), overwrite=True)
    assert objects(url) == tree(tmp_path / "plain")
    assert b"cc-by-4.0" in objects(url)["README.md"]


def test_another_build_in_the_way_is_refused_with_the_way_out(url, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        build(url, source=Counted(stop_at="c07"))
    with pytest.raises(CacheError, match=r"differs in its source, captures \(11 there, 12 now\).*--restart"):
        build(url, source=Counted(12))
    with pytest.raises(CacheError, match="one of several jobs cannot restart"):
        build(url, source=Counted(12), restart=True, part=(0, 2))
    report = build(url, source=Counted(12), restart=True)
    assert any(note.startswith("deleted 3 finished shards") for note in report.notes)
    assert objects(url) == plain(tmp_path, source=Counted(12))


# -- failures -------------------------------------------------------------------------------------------------------


def failing(monkeypatch, url: str, method: str, fails):
    """Let a method of the file system fail where ``fails`` says so of its arguments; return the calls."""
    files = type(fsspec.core.url_to_fs(url)[0])
    whole, calls = getattr(files, method), []

    def call(self, *args, **options):
        calls.append(args)
        if fails(len(calls), *args):
            raise ConnectionResetError("reset by peer")
        return whole(self, *args, **options)

    monkeypatch.setattr(files, method, call)
    return calls


@IN_MEMORY
def test_a_network_that_stays_away_stops_the_build_which_goes_on_later(url, tmp_path, monkeypatch):
    wanted = plain(tmp_path)
    with monkeypatch.context() as patch:
        calls = failing(patch, url, "put_file", lambda number, *_: number > 5)
        with pytest.raises(CacheError, match=r"cannot be written .*reset by peer.*tried 4 times") as caught:
            build(url)
        assert len(calls) == 5 + 4
    assert any("the same command goes on from there" in note for note in caught.value.__notes__)
    with monkeypatch.context() as patch:
        failing(patch, url, "put_file", lambda number, *_: number % 3 != 0)  # each put fails twice
        assert build(url).is_complete
    assert objects(url) == wanted


@IN_MEMORY
def test_a_stop_at_any_moment_of_putting_it_into_place_leaves_what_goes_on(url, tmp_path, monkeypatch):
    build(url, source=Counted(14))
    wanted, old = plain(tmp_path), objects(url)
    place, tried, left = BuildingUrl.put_into_place, WritableUrl._tried, [0]

    def counted(self, *args):
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt
        return tried(self, *args)

    def stopped(self, *args):
        with monkeypatch.context() as patch:
            patch.setattr(WritableUrl, "_tried", counted)
            place(self, *args)

    seen = set()
    with monkeypatch.context() as patch:
        patch.setattr(BuildingUrl, "put_into_place", stopped)
        for after in range(1, 400, 13):
            left[0] = after
            with suppress(KeyboardInterrupt):
                build(url, overwrite=True)
            there = objects(url)
            states = {"old": there == old, "new": there == wanted, "none": "dataset.json" not in there}
            seen |= {name for name, is_it in states.items() if is_it} or {"mixed"}
            if there == wanted:
                break
    assert seen == {"old", "none", "new"}
    build(url, overwrite=True)
    assert objects(url) == wanted
    assert beside(url) == {"set"}


@IN_MEMORY
def test_a_shard_that_was_spoilt_at_the_url_is_built_anew(url, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        build(url, source=Counted(stop_at="c10"))
    building = url.rpartition("/")[0] + "/.set.building"
    files, root = fsspec.core.url_to_fs(building)
    names = sorted(name for name in files.find(f"{root}/shards") if name.endswith(("npz", "tsv")))
    files.pipe_file(names[0], b"cut")
    files.pipe_file(next(name for name in names if "00002" in name and name.endswith("tsv")), b"x" * 9)
    files.rm_file(next(name for name in names if "00003" in name))
    source = Counted()
    build(url, source=source)
    assert source.loaded == ["c00", "c01", "c04", "c05", "c06", "c07", "c10"]
    assert objects(url) == plain(tmp_path)


def at_commit(monkeypatch, number: int, do) -> None:
    """Do something in the middle of a build: before so many shards are committed."""
    whole, left = BuildingUrl.commit, [number]

    def commit(self, *args):
        left[0] -= 1
        if left[0] == 0:
            do()
        whole(self, *args)

    monkeypatch.setattr(BuildingUrl, "commit", commit)


@IN_MEMORY
def test_two_builds_at_once_give_one_dataset(url, tmp_path, monkeypatch):
    wanted = plain(tmp_path)

    at_commit(monkeypatch, 3, lambda: build(url))
    with pytest.raises(CacheError, match="another process has put this dataset into place"):
        build(url)
    assert objects(url) == wanted
    assert beside(url) == {"set"}


@IN_MEMORY
def test_two_that_put_it_into_place_at_once_give_one_dataset(url, tmp_path, monkeypatch):
    wanted, whole = plain(tmp_path), PlacingAtUrl._begin

    def begin(self, names, replaced):
        gone = whole(self, names, replaced)
        monkeypatch.setattr(PlacingAtUrl, "_begin", whole)
        build(url, finalize=True)  # another process does it all, after this one has begun
        return gone

    monkeypatch.setattr(PlacingAtUrl, "_begin", begin)
    assert build(url).is_complete
    assert objects(url) == wanted
    assert beside(url) == {"set"}


@IN_MEMORY
def test_a_build_whose_place_another_took_stops_and_spoils_nothing(url, tmp_path, monkeypatch):
    def rob():
        with pytest.raises(KeyboardInterrupt):
            build(url, source=Counted(12, stop_at="c03"), restart=True)

    at_commit(monkeypatch, 3, rob)
    with pytest.raises(CacheError, match="another build, with other settings, has taken the place of this one"):
        build(url)
    build(url, source=Counted(12))
    assert objects(url) == plain(tmp_path, source=Counted(12))


# -- processes ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("url", ["local", "s3"], indirect=True)
def test_workers_put_their_shards_themselves(url, tmp_path, monkeypatch):
    monkeypatch.setattr("pcdata.build.engines.pool.START", "fork")
    torch.set_num_threads(1)
    assert build(url, workers=2).is_complete
    assert objects(url) == plain(tmp_path)
    assert os.listdir(tmp_path / "scratch") == []


def test_the_memory_of_a_process_takes_no_workers(tmp_path):
    with pytest.raises(ConfigError, match="workers=0"):
        build("memory://nowhere/set", workers=1)
