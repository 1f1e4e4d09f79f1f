"""The door for files that are read."""

from __future__ import annotations

import os
import socket
import threading
import tracemalloc

import numpy as np
import pytest

from pcdata.errors import CacheError, CaptureError
from pcdata.files import opening as files

DOORS = {
    "open_input": lambda path, **options: files.open_input("here", path, **options).close(),
    "existing_file": lambda path, **options: files.existing_file("here", path, **options),
    "read_bytes": lambda path, **options: files.read_bytes("here", path, **options),
    "read_text": lambda path, **options: files.read_text("here", path, **options),
    "map_npy": lambda path, **options: files.map_npy("here", path, **options),
}


@pytest.fixture(params=DOORS)
def door(request):
    return DOORS[request.param]


def test_a_fifo_is_refused_at_once(tmp_path, door):
    os.mkfifo(tmp_path / "pipe")
    done = []

    def ask():
        with pytest.raises(CaptureError, match="FIFO"):
            door(tmp_path / "pipe", max_bytes=100)
        done.append(True)

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(20)
    assert done, "waits for a writer"


def test_sockets_devices_and_folders_are_refused(tmp_path, door):
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "s"))
        with pytest.raises(CaptureError, match="socket"):
            door(tmp_path / "s", max_bytes=100)
    with pytest.raises(CaptureError, match="device"):
        door("/dev/zero", max_bytes=100)
    with pytest.raises(CaptureError, match="folder"):
        door(tmp_path, max_bytes=100)


def test_a_link_to_a_device_is_refused(tmp_path, door):
    (tmp_path / "link").symlink_to("/dev/zero")
    with pytest.raises(CaptureError, match="device"):
        door(tmp_path / "link", max_bytes=100)


def test_missing_empty_and_unnameable_files_are_told_apart(tmp_path, door):
    (tmp_path / "empty").touch()
    (tmp_path / "dangling").symlink_to(tmp_path / "never")
    (tmp_path / "round").symlink_to(tmp_path / "round")
    for name, words in {
        "none": "no such file",
        "empty": "is empty",
        "dangling": "fetch its content",
        "round": "cannot be opened",
        "a\0b": "cannot be opened",
        "a" * 300: "cannot be opened",
    }.items():
        with pytest.raises(CaptureError, match=words):
            door(tmp_path / name, max_bytes=100)


def test_a_file_over_the_limit_is_refused_before_it_is_read(tmp_path, door):
    with open(tmp_path / "large", "wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(CaptureError, match="limit"):
        door(tmp_path / "large", max_bytes=1 << 30)


def test_a_file_of_holes_is_refused_however_large_a_file_may_be(tmp_path, door):
    with open(tmp_path / "holes", "wb") as file:
        file.write(b"\x93NUMPY")
        file.truncate(8 << 30)
    with pytest.raises(CaptureError, match="holes"):
        door(tmp_path / "holes", max_bytes=1 << 40)


def test_a_file_stored_in_full_is_no_sparse_file(tmp_path):
    (tmp_path / "zeros").write_bytes(bytes(files._SPARSE_FROM + 1))
    assert files.existing_file("here", tmp_path / "zeros", max_bytes=1 << 30)


def test_files_outside_the_folder_are_refused_unless_the_store_is_named(tmp_path, door):
    capture, store = tmp_path / "capture", tmp_path / "store"
    capture.mkdir()
    store.mkdir()
    np.save(store / "a.npy", np.arange(3, dtype=np.int8))
    (capture / "leaves.npy").symlink_to(store / "a.npy")
    (capture / "folder").symlink_to(store)
    for path in (capture / "leaves.npy", capture / "folder" / "a.npy", capture / ".." / "store" / "a.npy"):
        with pytest.raises(CaptureError, match="leads out of"):
            door(path, max_bytes=1000, inside=[capture])


def test_links_may_stay_inside_lead_to_a_named_store_and_the_folder_may_be_a_link(tmp_path):
    capture, store = tmp_path / "capture", tmp_path / "store"
    capture.mkdir()
    store.mkdir()
    (store / "a").write_text("abc")
    (capture / "b").write_text("def")
    (capture / "leaves").symlink_to(store / "a")
    (capture / "stays").symlink_to(capture / "b")
    (tmp_path / "link").symlink_to(capture)
    assert files.read_text("here", capture / "leaves", inside=[capture, store]) == "abc"
    assert files.read_text("here", capture / "stays", inside=[capture]) == "def"
    assert files.read_text("here", tmp_path / "link" / "stays", inside=[tmp_path / "link"]) == "def"
    assert files.read_text("here", tmp_path / "link" / "b", inside=[capture]) == "def"


def test_a_folder_whose_name_begins_alike_is_another_folder(tmp_path):
    (tmp_path / "cap").mkdir()
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "a").write_text("abc")
    with pytest.raises(CaptureError, match="leads out of"):
        files.read_text("here", tmp_path / "cap" / ".." / "capture" / "a", inside=[tmp_path / "cap"])


def test_the_caller_names_the_error(tmp_path, door):
    with pytest.raises(CacheError):
        door(tmp_path / "none", max_bytes=100, error=CacheError)


def test_text_that_is_no_text_is_refused(tmp_path):
    (tmp_path / "a").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CaptureError, match="UTF-8"):
        files.read_text("here", tmp_path / "a")


@pytest.mark.parametrize("dtype", ["u1", "<u2", ">u2", "f4", "<f8", ">f8", "c8", "?"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npy_files_are_read_as_numpy_reads_them(tmp_path, dtype, order):
    array = np.asarray(np.arange(24).reshape(2, 3, 4).astype(dtype), order=order)
    np.save(tmp_path / "a.npy", array)
    read = files.map_npy("here", tmp_path / "a.npy", max_bytes=1 << 20)
    assert read.dtype == array.dtype
    np.testing.assert_array_equal(read, array)


@pytest.mark.parametrize("shape", [(), (0,), (3, 0), (1,)])
def test_npy_files_of_no_axis_and_no_number_are_read(tmp_path, shape):
    np.save(tmp_path / "a.npy", np.zeros(shape))
    assert files.map_npy("here", tmp_path / "a.npy", max_bytes=1 << 20).shape == shape


@pytest.mark.parametrize("claim", ["(5, 4)", "(20, 4)", "(10, 40000000000000000000)", "(-10, -4)", "(True, 40)", "'a'"])
def test_an_npy_header_must_claim_what_the_file_holds(tmp_path, claim):
    np.save(tmp_path / "a.npy", np.arange(40.0).reshape(10, 4))
    data = (tmp_path / "a.npy").read_bytes()
    header = data[10 : data.index(b"\n")].replace(b"(10, 4)", claim.encode()).rstrip().ljust(128 - 11)
    (tmp_path / "a.npy").write_bytes(data[:10] + header + data[data.index(b"\n") :])
    with pytest.raises(CaptureError, match=r"\.npy"):
        files.map_npy("here", tmp_path / "a.npy", max_bytes=1 << 20)


def test_objects_and_structures_are_never_read(tmp_path):
    np.save(tmp_path / "o.npy", np.array([{}], dtype=object), allow_pickle=True)
    np.save(tmp_path / "s.npy", np.zeros(3, dtype=[("a", "f4")]))
    np.save(tmp_path / "t.npy", np.array(["text"]))
    for name in ("o", "s", "t"):
        with pytest.raises(CaptureError, match=r"plain numbers|never unpickled"):
            files.map_npy("here", tmp_path / f"{name}.npy", max_bytes=1 << 20)


def test_reading_a_small_file_takes_little_memory_whatever_its_kind_may_hold(tmp_path):
    (tmp_path / "a").write_bytes(bytes(1000))
    tracemalloc.start()
    try:
        files.read_bytes("here", tmp_path / "a", max_bytes=1 << 32)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("length", [0, 1, 2, 65535])
def test_a_npy_header_of_an_impossible_length_is_told(tmp_path, length):
    content = bytearray((np.save(tmp_path / "a.npy", np.zeros(3)), (tmp_path / "a.npy").read_bytes())[1])
    content[8:10] = length.to_bytes(2, "little")
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(CaptureError, match=r"not a readable \.npy"):
        files.map_npy("here", tmp_path / "a.npy", max_bytes=1 << 20)


def test_a_path_that_who_asks_has_named_is_not_told_twice(tmp_path):
    from pcdata.io import read_color, read_depth

    (tmp_path / "d.npy").write_bytes(b"garbage")
    (tmp_path / "c.png").write_bytes(b"")
    for read in (
        lambda: read_depth(tmp_path / "d.npy", metres_per_unit=0.001),
        lambda: read_depth(tmp_path / "none.npy", metres_per_unit=0.001),
        lambda: read_depth(tmp_path / "c.png", metres_per_unit=0.001),
        lambda: read_color(tmp_path / "c.png"),
    ):
        with pytest.raises(CaptureError) as caught:
            read()
        assert str(caught.value).count(str(tmp_path)) == 1
