"""Stores: what is written is what is read, other tools can read it too, and no damaged or hostile file gets through."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import pickle
import struct
import time
import zipfile
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from pcdata import PointCloud, Signal
from pcdata.errors import CacheError
from pcdata.io.store.cloud_record import Record, cloud_from_record, record_from_cloud
from pcdata.io.store.stores import INFO, STORES
from tests.disk_limits import largest_file
from tests.io.memory import memory_limit
from tests.warm import run_python

KINDS = [(form, compression) for form, store in STORES.items() for compression in store.compressions]
FORMATS = list(STORES)


def full_cloud(seed: int = 0) -> PointCloud:
    """Three clouds (one of them empty) with every field that there is."""
    draw = torch.Generator().manual_seed(seed)
    n, counts = 37, [20, 0, 17]
    normals = torch.nn.functional.normalize(torch.randn(n, 3, generator=draw), dim=1)
    matrices = torch.randn(3, 4, 4, generator=draw, dtype=torch.float64)
    matrices[:, 3] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    k = [[600.0, 0.0, 319.5], [0.0, 601.0, 239.5], [0.0, 0.0, 1.0]]
    camera = {"intrinsics": [k], "size": [480, 640], "distortion": None, "world_from_camera": matrices[0].tolist()}
    return PointCloud(
        points=torch.randn(n, 3, generator=draw),
        ptr=torch.tensor([0, counts[0], counts[0], n]),
        frame_id="robot/base",
        colors=torch.rand(n, 3, generator=draw),
        normals=normals,
        labels=torch.randint(-1, 9, (n,), generator=draw),
        source_index=torch.randint(0, 2**40, (n,), generator=draw),
        extra={
            "viewpoint": torch.randn(n, 3, generator=draw),
            "flow": torch.randn(n, 3, generator=draw),
            "confidence": torch.randint(0, 256, (n,), generator=draw).to(torch.uint8),
            "inlier": torch.rand(n, generator=draw) < 0.5,
            "feature": torch.randn(n, 5, generator=draw, dtype=torch.float64),
            "half": torch.randn(n, generator=draw).half(),
        },
        kinds={
            "viewpoint": "position",
            "flow": "direction",
            "confidence": "invariant",
            "inlier": "invariant",
            "feature": "invariant",
            "half": "invariant",
        },
        viewpoint=torch.randn(3, 3, generator=draw),
        source_from_cloud=matrices,
        source_frame="camera",
        frames={"camera": matrices @ matrices, "robot/tool 0": matrices.flip(0)},
        unit="normalized",
        meta=[{"sample_id": "a/b é", "planes": [[0.1, 0.2, 0.3, 1e-300]], "cameras": [camera]}, {}, {"none": None}],
        history=[[{"step": "Deproject", "points": 20, "fields": {}}], [], [{"step": "X"}, {"step": "Y"}]],
        recorded_signals={
            "robot/state é": Signal(torch.randn(3, 2, 7, generator=draw, dtype=torch.float64), "invariant"),
            "action": Signal(torch.randn(3, 4, generator=draw), "position + invariant 1", "robot/tool 0"),
            "open": Signal(torch.tensor([True, False, True]), "invariant"),
            "task": Signal(("pick é", "", "a\nb"), "text"),
            "none": Signal(torch.zeros(3, 0), "invariant"),
        },
    )


def empty_cloud() -> PointCloud:
    return PointCloud(points=torch.zeros(0, 3), frame_id="camera", labels=torch.zeros(0, dtype=torch.int64))


def assert_same_cloud(a: PointCloud, b: PointCloud) -> None:
    for field in dataclasses.fields(PointCloud):
        mine, other = getattr(a, field.name), getattr(b, field.name)
        if field.name == "recorded_signals":
            assert list(mine) == list(other)
            assert all(signal.same_bits(other[name]) for name, signal in mine.items())
            continue
        if field.name in ("extra", "frames"):
            assert mine.keys() == other.keys()
            pairs = [(mine[name], other[name]) for name in mine]
        else:
            pairs = [(mine, other)]
        for one, two in pairs:
            if isinstance(one, torch.Tensor):
                assert one.dtype == two.dtype, field.name
                assert torch.equal(one, two), field.name
            else:
                assert one == two, field.name


def write(folder: Path, cloud: PointCloud, form: str, compression: str = "none", key: str = "a") -> Path:
    store = STORES[form](folder, compression)
    store.write(key, record_from_cloud(cloud))
    store.close()
    return store.path_of(key)


def refused(folder: Path, form: str, path: Path, key: str = "a") -> str:
    """Read and return the message of the CacheError that must come, naming the file."""
    with memory_limit(512 * 2**20), closing(STORES[form](folder)) as store, pytest.raises(CacheError) as caught:
        store.read(key)
    assert str(path) in str(caught.value)
    return str(caught.value)


# -- round trips ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("form", "compression"), KINDS)
def test_a_cloud_with_every_field_comes_back_identical(tmp_path, form, compression):
    cloud = full_cloud()
    write(tmp_path, cloud, form, compression)
    record = STORES[form](tmp_path).read("a")
    assert_same_cloud(cloud_from_record(record), cloud)
    assert record.digest() == record_from_cloud(cloud).digest()


@pytest.mark.parametrize(("form", "compression"), KINDS)
def test_an_empty_cloud_comes_back(tmp_path, form, compression):
    write(tmp_path, empty_cloud(), form, compression)
    assert_same_cloud(cloud_from_record(STORES[form](tmp_path).read("a")), empty_cloud())


@pytest.mark.parametrize("form", FORMATS)
def test_many_records_live_side_by_side(tmp_path, form):
    store = STORES[form](tmp_path)
    for seed in range(4):
        store.write(f"key{seed}", record_from_cloud(full_cloud(seed)))
    store.close()
    reader = STORES[form](tmp_path)
    for seed in (2, 0, 3, 1):
        assert_same_cloud(cloud_from_record(reader.read(f"key{seed}")), full_cloud(seed))


@pytest.mark.parametrize("form", FORMATS)
def test_a_history_longer_than_64_kb_comes_back(tmp_path, form):
    long = dataclasses.replace(empty_cloud(), history=[[{"step": "X" * 1000, "points": i} for i in range(200)]])
    write(tmp_path, long, form)
    assert_same_cloud(cloud_from_record(STORES[form](tmp_path).read("a")), long)


@pytest.mark.parametrize("form", FORMATS)
def test_what_was_read_can_be_written_to_in_place(tmp_path, form):
    write(tmp_path, full_cloud(), form)
    cloud = cloud_from_record(STORES[form](tmp_path).read("a"))
    cloud.points.add_(1.0)  # a read-only NumPy buffer would warn or crash here
    assert torch.equal(cloud.points, full_cloud().points + 1.0)


@pytest.mark.slow
def test_two_writes_at_different_times_are_byte_identical(tmp_path):
    def bytes_of(folder: Path) -> dict[tuple[str, str], bytes]:
        return {
            (form, compression): write(folder / form / compression, full_cloud(), form, compression).read_bytes()
            for form, compression in KINDS
        }

    for form, compression in KINDS:
        for name in ("one", "two"):
            (tmp_path / name / form / compression).mkdir(parents=True)
    first = bytes_of(tmp_path / "one")
    time.sleep(2.1)  # zip counts time in steps of 2 s, HDF5 in seconds
    assert bytes_of(tmp_path / "two") == first


# -- what plain users see ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", STORES["npz"].compressions)
def test_numpy_alone_reads_an_npz(tmp_path, compression):
    cloud = full_cloud()
    with np.load(write(tmp_path, cloud, "npz", compression)) as stored:  # allow_pickle is off by default
        for name in ("points", "colors", "normals"):
            assert stored[name].dtype == np.float32
            assert np.array_equal(stored[name], getattr(cloud, name).numpy())
        assert 0 <= stored["colors"].min() <= stored["colors"].max() <= 1
        assert stored["labels"].dtype == np.int32
        assert np.array_equal(stored["labels"], cloud.labels.numpy()[:, None])


def test_h5py_alone_reads_a_group_per_scene_with_the_way_back(tmp_path):
    cloud = full_cloud()
    with h5py.File(write(tmp_path, cloud, "hdf5", key="scene-7"), "r") as file:
        assert list(file) == ["scene-7"]
        group = file["scene-7"]
        assert {"points", "colors", "normals", "labels", "intrinsics", "extrinsics"} <= set(group)
        assert group["points"].shape == (37, 3)
        assert group["labels"].shape == (37, 1)
        assert group["intrinsics"][0].tolist() == cloud.meta[0]["cameras"][0]["intrinsics"][0]
        assert group["extrinsics"][0].tolist() == cloud.meta[0]["cameras"][0]["world_from_camera"]
        assert np.array_equal(group["source_from_cloud"][()], cloud.source_from_cloud.numpy())
        facts = json.loads(group[INFO][()])
        assert facts["frame_id"] == group.attrs["frame_id"] == "robot/base"
        assert facts["unit"] == group.attrs["unit"] == "normalized"
        assert facts["source_frame"] == "camera"


def test_torch_alone_reads_a_pt_as_a_dict_of_tensors(tmp_path):
    cloud = full_cloud()
    stored = torch.load(write(tmp_path, cloud, "pt"), weights_only=True)
    assert torch.equal(stored["points"], cloud.points)
    assert stored["labels"].dtype == torch.int32
    assert stored["labels"].shape == (37, 1)
    assert json.loads(stored[INFO])["meta"][0]["sample_id"] == "a/b é"


def test_a_pt_file_of_a_sliced_cloud_holds_the_slice_alone(tmp_path):
    big = PointCloud(points=torch.rand(500_000, 3), ptr=torch.tensor([0, 10, 500_000]), frame_id="base")
    small = big.unbatch()[0]
    assert small.points.untyped_storage().nbytes() > 5_000_000  # still a view of everything
    assert write(tmp_path, small, "pt").stat().st_size < 10_000


@pytest.mark.parametrize("form", FORMATS)
def test_points_stored_by_columns_come_back(tmp_path, form):
    cloud = PointCloud(points=torch.rand(3, 50).T, frame_id="base")
    write(tmp_path, cloud, form)
    assert torch.equal(cloud_from_record(STORES[form](tmp_path).read("a")).points, cloud.points)


# -- damaged files -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("form", "compression"), KINDS)
def test_a_file_cut_anywhere_is_a_cache_error_that_names_it(tmp_path, form, compression):
    path = write(tmp_path, full_cloud(), form, compression)
    content = path.read_bytes()
    for cut in sorted({0, 1, 4, 8, 30, 64, 512, *range(0, len(content), len(content) // 40), len(content) - 1}):
        path.write_bytes(content[:cut])
        refused(tmp_path, form, path)


@pytest.mark.parametrize(("form", "compression"), KINDS)
def test_a_flipped_byte_is_noticed_or_harmless(tmp_path, form, compression):
    cloud = full_cloud()
    digest = record_from_cloud(cloud).digest()
    path = write(tmp_path, cloud, form, compression)
    content = path.read_bytes()
    noticed = 0
    for place in range(3, len(content), len(content) // 150):
        damaged = bytearray(content)
        damaged[place] ^= 0xFF
        path.write_bytes(damaged)
        store = STORES[form](tmp_path)
        try:
            noticed += store.read("a").digest() != digest
        except CacheError as error:
            assert str(path) in str(error)  # noqa: PT017  # harmless bytes (times, padding) raise nothing
            noticed += 1
        finally:
            store.close()
    assert noticed > 20


@pytest.mark.parametrize("form", FORMATS)
def test_a_missing_record_is_a_cache_error_that_names_the_file(tmp_path, form):
    path = write(tmp_path, full_cloud(), form)
    assert "missing" in refused(tmp_path / "nowhere", form, STORES[form](tmp_path / "nowhere").path_of("a"))
    message = refused(tmp_path, form, STORES[form](tmp_path).path_of("b"), key="b")
    assert "missing" in message or "no group 'b'" in message
    assert path.exists()


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("content", [b"", b"\0" * 4096, b"PK\x03\x04", b"\x89HDF\r\n\x1a\n", b"not a file" * 99])
def test_a_file_of_another_kind_is_a_cache_error(tmp_path, form, content):
    path = write(tmp_path, full_cloud(), form)
    path.write_bytes(content)
    assert "rebuild" in refused(tmp_path, form, path)


@pytest.mark.parametrize("form", ["npz", "pt"])
def test_an_existing_record_is_never_overwritten(tmp_path, form):
    path = write(tmp_path, full_cloud(), form)
    content = path.read_bytes()
    with pytest.raises(CacheError, match="cannot be written"):
        write(tmp_path, empty_cloud(), form)
    assert path.read_bytes() == content


@pytest.mark.parametrize("form", FORMATS)
def test_a_folder_that_cannot_be_written_to_is_a_cache_error(tmp_path, form):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(CacheError, match="cannot be written"):
        write(tmp_path / "file", full_cloud(), form)


@pytest.mark.parametrize("form", FORMATS)
def test_a_full_disk_is_a_cache_error_that_names_the_file(tmp_path, form):
    big = PointCloud(points=torch.rand(100_000, 3), frame_id="base")
    with largest_file(200_000), pytest.raises(CacheError, match="cannot be written") as caught:
        write(tmp_path, big, form)
    assert str(STORES[form](tmp_path).path_of("a")) in str(caught.value)


@pytest.mark.parametrize("disk_is_full", [True, False])
def test_an_hdf5_store_that_is_left_open_lets_the_process_end(tmp_path, disk_is_full):
    code = f"""
import numpy as np
from pcdata.errors import CacheError
from pcdata.io.store.cloud_record import Record
from pcdata.io.store.hdf5_store import Hdf5Store
from tests.disk_limits import limit_files
store = Hdf5Store({str(tmp_path)!r})
if {disk_is_full}:
    limit_files(200_000)
try:
    store.write("a", Record({{"points": np.zeros((100_000, 3), np.float32)}}, {{"frame_id": "base", "unit": "m"}}))
    print("written")
except CacheError as error:
    kept = error
    print(error)
"""
    done = run_python(code)
    assert done.returncode == 0, (done.returncode, done.stderr)
    assert done.stdout.count("cannot be written") == disk_is_full


# -- hostile npz ---------------------------------------------------------------------------------------------------


class Malicious:
    """Runs a command when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return os.system, (f"touch {self.marker}",)


def npz_with(path: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def npy_claiming(shape: str, descr: str = "'<f4'", body: bytes = b"\0" * 64) -> bytes:
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}"
    header += " " * (-(len(header) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + body


def test_an_npz_with_a_pickled_array_is_refused_and_not_run(tmp_path):
    path = tmp_path / "clouds" / "a.npz"
    path.parent.mkdir()
    np.savez(path, points=np.array([Malicious(tmp_path / "run")], dtype=object), allow_pickle=True)
    refused(tmp_path, "npz", path)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "content",
    [
        npy_claiming("(4000000000000, 3)"),
        npy_claiming("(-1, 3)"),
        npy_claiming("(99999999999999999999999999, 3)"),
        npy_claiming("(4, 'a')"),
        npy_claiming("(4,)", descr="'|O'"),
        npy_claiming("(4,)", descr="'<U999999999'"),
        npy_claiming("(4,)", descr="[('a', '<f4', (1000000000,))]"),
        npy_claiming("-" * 9000 + "1"),
        npy_claiming("(" * 300 + ")" * 300),
        b"\x93NUMPY\x03\x00" + b"\0" * 64,
        b"\x93NUMPY\x01\x00\xff\xff",
        b"",
        b"pickle me",
    ],
    ids=range(13),
)
def test_an_npz_whose_header_lies_is_refused_before_anything_is_allocated(tmp_path, content):
    path = tmp_path / "clouds" / "a.npz"
    npz_with(path, {"points.npy": content})
    refused(tmp_path, "npz", path)


def test_a_zip_bomb_is_refused(tmp_path):
    path = tmp_path / "clouds" / "a.npz"
    claimed = 4_000_000_000
    npz_with(path, {"points.npy": npy_claiming(f"({claimed // 4},)", body=b"\0" * 1000)}, zipfile.ZIP_DEFLATED)
    content = bytearray(path.read_bytes())
    place = content.index(b"PK\x01\x02")
    content[place + 24 : place + 28] = struct.pack("<I", claimed + 128)  # the size it claims to unpack to
    path.write_bytes(content)
    refused(tmp_path, "npz", path)
    content[place + 20 : place + 24] = struct.pack("<I", claimed)  # now the packed size lies as well
    path.write_bytes(content)
    assert "claim" in refused(tmp_path, "npz", path)


def test_an_npz_with_two_members_of_one_name_is_refused(tmp_path):
    path = write(tmp_path, full_cloud(), "npz")
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(path, "a") as archive:
        archive.writestr("points.npy", npy_claiming("(16,)"))
    assert "one name" in refused(tmp_path, "npz", path)


def test_an_npz_without_the_facts_is_refused(tmp_path):
    path = tmp_path / "clouds" / "a.npz"
    path.parent.mkdir()
    np.savez(path, points=np.zeros((4, 3), np.float32))
    assert INFO in refused(tmp_path, "npz", path)


# -- hostile pt ----------------------------------------------------------------------------------------------------


class _PtPickler(pickle.Pickler):
    def persistent_id(self, obj):
        return obj.reference if isinstance(obj, _Storage) else None


class _Storage:
    def __init__(self, numel: int) -> None:
        self.reference = ("storage", torch.FloatStorage, "0", "cpu", numel)


class _Tensor:
    def __init__(self, numel: int, size: tuple[int, ...], stride: tuple[int, ...]) -> None:
        self.arguments = (_Storage(numel), 0, size, stride, False, OrderedDict())

    def __reduce__(self):
        return torch._utils._rebuild_tensor_v2, self.arguments


class _Allocation:
    def __reduce__(self):
        return bytearray, (3_000_000_000,)


def pt_with(path: Path, content: object, compression: int = zipfile.ZIP_STORED) -> None:
    stream = io.BytesIO()
    _PtPickler(stream, 2).dump(content)
    parts = {"data.pkl": stream.getvalue(), "byteorder": b"little", "data/0": b"\0" * 16, "version": b"3\n"}
    npz_with(path, {f"archive/{name}": part for name, part in parts.items()}, compression)


def test_the_forged_pt_of_these_tests_is_one_that_torch_reads(tmp_path):
    pt_with(tmp_path / "a.pt", {"points": _Tensor(4, (4,), (1,))})
    assert torch.load(tmp_path / "a.pt", weights_only=True)["points"].tolist() == [0.0] * 4


@pytest.mark.parametrize("legacy", [False, True])
def test_a_malicious_pt_is_refused_and_not_run(tmp_path, legacy):
    path = tmp_path / "clouds" / "a.pt"
    path.parent.mkdir()
    torch.save({"points": Malicious(tmp_path / "run")}, path, _use_new_zipfile_serialization=not legacy)
    refused(tmp_path, "pt", path)
    path.write_bytes(pickle.dumps(Malicious(tmp_path / "run")))
    refused(tmp_path, "pt", path)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "content",
    [
        {"points": _Allocation()},
        {"points": _Tensor(4, (1_000_000_000,), (0,))},
        {"points": _Tensor(4, (1_000_000_000,), (1,))},
        {"points": _Tensor(1_000_000_000, (1_000_000_000,), (1,))},
        {"points": [1, 2, 3]},
        {5: _Tensor(4, (4,), (1,))},
        {"points": _Tensor(4, (4,), (1,)), "pcdata": b"{}"},
        [1, 2],
        "text",
    ],
    ids=range(9),
)
def test_a_pt_that_holds_more_than_its_tensors_is_refused_before_it_allocates(tmp_path, content):
    if isinstance(content, dict):
        content = {INFO: "{}", **content}
    path = tmp_path / "clouds" / "a.pt"
    pt_with(path, content)
    refused(tmp_path, "pt", path)


def test_a_compressed_pt_is_refused(tmp_path):
    path = tmp_path / "clouds" / "a.pt"
    pt_with(path, {INFO: "{}"}, zipfile.ZIP_DEFLATED)
    assert "compressed" in refused(tmp_path, "pt", path)


# -- hostile hdf5 --------------------------------------------------------------------------------------------------


@contextmanager
def tampered(path: Path) -> Iterator[h5py.Group]:
    with h5py.File(path, "r+") as file:
        del file["a/points"]
        yield file["a"]


@pytest.fixture
def h5(tmp_path) -> Path:
    (tmp_path / "secret.txt").write_bytes(b"secret" * 100)
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["points"] = np.zeros((37, 3), np.float32)
    return write(tmp_path, full_cloud(), "hdf5")


def test_h5_links_to_elsewhere_are_refused(tmp_path, h5):
    for link in (h5py.ExternalLink("other.h5", "/points"), h5py.SoftLink("/a/colors"), h5py.SoftLink("/nowhere")):
        with h5py.File(h5, "r+") as file:
            file["a"].pop("points", None) if "points" in file["a"] else None
            if file["a"].get("points", getlink=True) is not None:
                del file["a/points"]
            file["a"]["points"] = link
        assert "link" in refused(tmp_path, "hdf5", h5)


def test_h5_whose_group_is_a_link_is_refused(tmp_path, h5):
    with h5py.File(h5, "r+") as file:
        file["soft"] = h5py.SoftLink("/a")
        file["external"] = h5py.ExternalLink("other.h5", "/")
        file["dataset"] = np.zeros(3)
    for key in ("soft", "external"):
        assert "no group" in refused(tmp_path, "hdf5", h5, key=key)
    assert "must be a group" in refused(tmp_path, "hdf5", h5, key="dataset")


def test_h5_that_stores_its_data_in_another_file_is_refused(tmp_path, h5):
    with tampered(h5) as group:
        external = [(str(tmp_path / "secret.txt"), 0, 444)]
        group.create_dataset("points", (37, 3), np.float32, external=external)
    assert "link to another" in refused(tmp_path, "hdf5", h5)


def test_an_h5_virtual_dataset_is_refused(tmp_path, h5):
    layout = h5py.VirtualLayout((37, 3), np.float32)
    layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "points", (37, 3))
    with tampered(h5) as group:
        group.create_virtual_dataset("points", layout)
    assert "link to another" in refused(tmp_path, "hdf5", h5)


@pytest.mark.parametrize(
    "options",
    [
        {"shape": (10**10, 3), "chunks": (1000, 3)},
        {"shape": (10**10, 3), "chunks": (1000, 3), "compression": "gzip"},
        {"shape": (10**10, 3)},
        {"shape": (37, 3), "chunks": (3 * 10**8, 3), "maxshape": (None, 3), "compression": "gzip"},
    ],
    ids=["chunked", "packed", "contiguous", "one huge chunk"],
)
def test_an_h5_dataset_that_claims_more_than_it_stores_is_refused(tmp_path, h5, options):
    with tampered(h5) as group:
        group.create_dataset("points", dtype=np.float32, **options)
    assert "claims" in refused(tmp_path, "hdf5", h5)


def test_h5_texts_and_references_in_place_of_numbers_are_refused(tmp_path, h5):
    for dtype in (h5py.string_dtype(), h5py.ref_dtype, h5py.vlen_dtype(np.float32), np.dtype([("x", "f4")])):
        with h5py.File(h5, "r+") as file:
            del file["a/points"]
            file["a"].create_dataset("points", (4,), dtype)
        refused(tmp_path, "hdf5", h5)
    with h5py.File(h5, "r+") as file:
        del file["a/points"]
        file["a"]["points"] = h5py.Empty("f4")
    refused(tmp_path, "hdf5", h5)


def test_h5_without_the_facts_is_refused(tmp_path, h5):
    with h5py.File(h5, "r+") as file:
        del file["a"][INFO]
    assert INFO in refused(tmp_path, "hdf5", h5)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("text", ["[1]", "{", '{"schema": 1}', '"' + "[" * 50_000])
def test_facts_that_are_not_a_cloud_are_refused(tmp_path, form, text):
    class Forged(Record):
        def info_text(self) -> str:
            return text

    record = record_from_cloud(full_cloud())
    store = STORES[form](tmp_path)
    store.write("a", Forged(record.arrays, record.info))
    store.close()
    with pytest.raises(CacheError):
        cloud_from_record(STORES[form](tmp_path).read("a"))


# -- handles -------------------------------------------------------------------------------------------------------


def test_a_store_pickles_with_its_file_open(tmp_path):
    write(tmp_path, full_cloud(), "hdf5")
    store = STORES["hdf5"](tmp_path)
    store.read("a")
    copy = pickle.loads(pickle.dumps(store))
    assert_same_cloud(cloud_from_record(copy.read("a")), full_cloud())
    store.close()
    assert_same_cloud(cloud_from_record(copy.read("a")), full_cloud())
    assert_same_cloud(cloud_from_record(store.read("a")), full_cloud())  # a closed store opens again


def test_reading_leaves_no_handle_behind_but_that_of_hdf5(tmp_path):
    for form in FORMATS:
        write(tmp_path, full_cloud(), form)

    def open_files() -> list[str]:
        links = [Path("/proc/self/fd") / name for name in os.listdir("/proc/self/fd")]
        return [os.readlink(link) for link in links if link.exists() and str(tmp_path) in os.readlink(link)]

    for form in FORMATS:
        store = STORES[form](tmp_path)
        for _ in range(5):
            store.read("a")
        assert len(open_files()) == (form == "hdf5")  # a mapped file needs none
        store.close()
        assert not open_files()
        STORES[form](tmp_path).read("a")  # dropped without close
        assert not open_files()
