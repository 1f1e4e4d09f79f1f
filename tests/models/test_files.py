"""Files that others wrote, and our own data sets, against a model."""

from __future__ import annotations

import bz2
import gzip
import json
import lzma
import re
import sys
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest

from pcdata.build import build_dataset, config_from_yaml
from pcdata.cli import main
from pcdata.errors import CacheError, ConfigError, MissingExtraError
from pcdata.exports.zarr_v2 import RowWriter
from pcdata.io.arrays import zarr_codecs
from pcdata.io.arrays.zarr_arrays import zarr_array, zarr_names
from pcdata.models import CONTRACTS, check_files, preset
from pcdata.models.pages import contract_page, index_page
from pcdata.synthetic import SyntheticSource
from pcdata.verdicts import Verdict
from tests.models.captures import correct_batch

DOCS = Path(__file__).parents[2] / "docs" / "models"
PACKERS = {
    None: lambda content: content,
    "zlib": zlib.compress,
    "gzip": gzip.compress,
    "bz2": bz2.compress,
    "lzma": lzma.compress,
}


def write_zarr(folder: Path, array: np.ndarray, chunks: tuple[int, ...], packer: str | None = None, fill=0) -> None:
    """Write one array as the zarr v2 specification says, edge chunks padded."""
    folder.mkdir(parents=True)
    header = {"zarr_format": 2, "shape": array.shape, "chunks": chunks, "dtype": array.dtype.str, "order": "C"}
    header |= {"compressor": packer and {"id": packer}, "filters": None, "fill_value": fill}
    (folder / ".zarray").write_text(json.dumps(header))
    for position in np.ndindex(*[-(-size // chunk) for size, chunk in zip(array.shape, chunks)]):
        block = np.full(chunks, fill, array.dtype)
        part = array[tuple(slice(p * c, (p + 1) * c) for p, c in zip(position, chunks))]
        block[tuple(slice(0, size) for size in part.shape)] = part
        (folder / (".".join(map(str, position)) or "0")).write_bytes(PACKERS[packer](block.tobytes()))


@pytest.mark.parametrize("packer", PACKERS)
def test_zarr_arrays_are_read_row_by_row_and_whole(tmp_path, packer):
    array = np.random.default_rng(0).normal(size=(7, 5, 3)).astype(np.float32)
    write_zarr(tmp_path / "data" / "point_cloud", array, (3, 4, 2), packer)
    stored = zarr_array(tmp_path, "data/point_cloud")
    assert np.array_equal(stored[...], array)
    assert all(np.array_equal(stored[row], array[row]) for row in range(7))
    assert zarr_names(tmp_path, 10) == ["data/point_cloud"]


@pytest.mark.parametrize("compression", ["zlib", "none"])
def test_what_our_exports_write_is_read_back(tmp_path, compression):
    rows = np.random.default_rng(1).normal(size=(7, 4, 6)).astype(np.float32)
    writer = RowWriter(tmp_path / "a", rows.shape, "<f4", chunk_rows=3, compression=compression)
    for row in rows:
        writer.add(row)
    assert np.array_equal(zarr_array(tmp_path, "a")[...], rows)


def test_a_zarr_chunk_that_is_missing_is_named_not_read_as_the_fill_value(tmp_path):
    array = np.arange(12.0).reshape(4, 3)
    write_zarr(tmp_path / "a", array, (2, 3), fill=-1.0)
    (tmp_path / "a" / "1.0").unlink()
    with pytest.raises(CacheError, match=r"claims 2 chunks.*but has 1; missing is 1\.0.*write_empty_chunks=True"):
        zarr_array(tmp_path, "a")[...]


def test_an_array_without_axes_is_read_from_its_one_chunk(tmp_path):
    write_zarr(tmp_path / "a", np.array(5.0), ())
    assert float(zarr_array(tmp_path, "a")[...]) == 5.0
    (tmp_path / "a" / "0").unlink()
    with pytest.raises(CacheError, match="missing is 0"):
        zarr_array(tmp_path, "a")[...]


def test_neighboring_rows_decode_their_chunk_once(tmp_path, monkeypatch):
    array = np.arange(24.0).reshape(8, 3)
    write_zarr(tmp_path / "a", array, (4, 3), "zlib")
    decoded = []
    monkeypatch.setitem(
        zarr_codecs.COMPRESSORS, "zlib", lambda _: lambda content, most: decoded.append(1) or zlib.decompress(content)
    )
    stored = zarr_array(tmp_path, "a")
    assert all(np.array_equal(stored[row], array[row]) for row in range(8))
    assert len(decoded) == 2


CODECS = {
    "as DP3's converters have it": lambda codecs: codecs.Blosc(cname="zstd", clevel=3, shuffle=1),
    "as the replay buffer saves": lambda codecs: codecs.Blosc("zstd", clevel=5, shuffle=codecs.Blosc.BITSHUFFLE),
    "zarr's default": lambda codecs: codecs.Blosc(),
    "zstd": lambda codecs: codecs.Zstd(),
    "zlib": lambda codecs: codecs.Zlib(),
    "none": lambda codecs: None,
}


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("filtered", [False, True])
def test_what_the_zarr_package_writes_is_read(tmp_path, codec, filtered):
    codecs = pytest.importorskip("numcodecs", reason="numcodecs is not installed")
    zarr = pytest.importorskip("zarr", reason="zarr is not installed")
    if zarr.__version__.startswith("3"):
        pytest.skip("zarr 3 writes another format; the loaders pin 2")
    arrays = {
        "data/point_cloud": np.random.default_rng(0).normal(size=(7, 5, 6)).astype(np.float32),
        "meta/episode_ends": np.array([3, 7]),
    }
    group = zarr.open_group(str(tmp_path / "store"), "w")
    for name, values in arrays.items():
        filters = [codecs.Delta(values.dtype.str)] if filtered and values.dtype.kind == "i" else None
        chunks = (3, *values.shape[1:])
        group.create_dataset(name, data=values, chunks=chunks, compressor=CODECS[codec](codecs), filters=filters)
    stored = {name: zarr_array(tmp_path / "store", name) for name in arrays}
    for name, values in arrays.items():
        assert stored[name].dtype == values.dtype
        assert np.array_equal(stored[name][...], values)
        assert all(np.array_equal(stored[name][row], values[row]) for row in range(len(values)))


def test_faulty_zarr_directories_are_refused(tmp_path, monkeypatch):
    with pytest.raises(CacheError, match="no zarr v2 array"):
        zarr_names(tmp_path, 10)
    write_zarr(tmp_path / "a", np.zeros((4, 3)), (2, 3), "zlib")
    good = (tmp_path / "a" / "0.0").read_bytes()
    (tmp_path / "a" / "0.0").write_bytes(b"no zlib")
    with pytest.raises(CacheError, match="this chunk cannot be read"):
        zarr_array(tmp_path, "a")[0]
    (tmp_path / "a" / "0.0").write_bytes(good)
    header = json.loads((tmp_path / "a" / ".zarray").read_text())
    (tmp_path / "a" / ".zarray").write_text(json.dumps({**header, "compressor": {"id": "blosc"}}))
    monkeypatch.setitem(sys.modules, "numcodecs", None)  # as if it were not installed
    with pytest.raises(MissingExtraError, match="Blosc"):
        zarr_array(tmp_path, "a")[0]
    (tmp_path / "zarr.json").write_text("{}")
    with pytest.raises(CacheError, match="zarr v3"):
        zarr_names(tmp_path, 10)


def test_a_dp3_zarr_passes_and_one_in_millimetres_fails(tmp_path):
    cloud = correct_batch("dp3_real")["point_cloud"].numpy()
    write_zarr(tmp_path / "good" / "data" / "point_cloud", cloud, (100, 1024, 6))
    cloud = cloud.copy()
    cloud[..., :3] *= 1000
    write_zarr(tmp_path / "bad" / "data" / "point_cloud", cloud, (100, 1024, 6), "zlib")
    keys = {"point_cloud": "data/point_cloud"}
    good = check_files(tmp_path / "good", "dp3_real", keys, frame_id="base", unit="m", frame="base")
    assert good.verdict is Verdict.UNKNOWN  # the order of the channels is not known
    assert sum(good.samples.values()) == 2
    bad = check_files(tmp_path / "bad", "dp3_real", keys, frame_id="base", unit="m", frame="base")
    assert {name for (name, _), entry in bad.checks.items() if entry.counts[Verdict.FAIL]} == {"scale"}


@pytest.mark.parametrize("dtype", ["<f8", ">f4", ">f8", "<f2"])
def test_a_file_is_read_as_the_loaders_read_it_whatever_the_width_of_its_numbers(tmp_path, dtype):
    """DP3's convert_real_robot_data.py stores float64; its data sets say astype(np.float32)."""
    cloud = correct_batch("dp3_real")["point_cloud"].numpy().astype(dtype)
    write_zarr(tmp_path / "store" / "data" / "point_cloud", cloud, (100, 1024, 6), "zlib")
    keys = {"point_cloud": "data/point_cloud"}
    summary = check_files(tmp_path / "store", "dp3_real", keys, frame_id="base", unit="m", frame="base")
    failed = {name for (name, _), entry in summary.checks.items() if entry.counts[Verdict.FAIL]}
    assert failed <= ({"duplicates"} if dtype == "<f2" else set())
    huge = np.full((1, 1024, 6), 1e300)
    write_zarr(tmp_path / "huge" / "data" / "point_cloud", huge, (100, 1024, 6))
    summary = check_files(tmp_path / "huge", "dp3_real", keys, frame_id="base", unit="m", frame="base")
    assert summary.checks["finite", None].counts[Verdict.FAIL] == 1


@pytest.mark.parametrize("kind", ["npz", "h5"])
def test_points_and_colors_by_role_are_joined_in_the_models_order(tmp_path, kind):
    cloud = correct_batch("dp3_real")["point_cloud"].numpy()
    path = tmp_path / f"clouds.{kind}"
    if kind == "npz":
        np.savez(path, xyz=cloud[..., :3], rgb=cloud[..., 3:])
    else:
        with h5py.File(path, "w") as file:
            file["xyz"], file["rgb"] = cloud[..., :3], cloud[..., 3:]
    given = {"frame_id": "base", "unit": "m", "frame": "base", "limit": 1}
    joined = check_files(path, "dp3_real", {"colors": "rgb", "points": "xyz"}, **given)
    assert joined.verdict is Verdict.PASS
    alone = check_files(path, "dp3_real", {"points": "xyz"}, **given)
    assert {name for (name, _), entry in alone.checks.items() if entry.counts[Verdict.FAIL]} == {"layout", "channels"}


def test_channels_first_models_take_the_rows_that_files_hold(tmp_path):
    points = correct_batch("pointnet2_cls")["points"].numpy().transpose(0, 2, 1)
    path = tmp_path / "clouds.npz"
    np.savez(path, p=points[..., :3], n=points[..., 3:])
    keys = {"points": "p", "normals": "n"}
    summary = check_files(path, "pointnet2_cls", keys, frame_id="base", unit="normalized", frame="base")
    assert not summary.samples[Verdict.FAIL]


@pytest.mark.parametrize(("name", "words"), [("folder", "holds no zarr v2 array"), ("scan.pcd", r"is no \.npz")])
def test_what_is_no_file_of_arrays_is_told_before_keys_are_asked_for(tmp_path, name, words):
    (tmp_path / "folder").mkdir()
    (tmp_path / "scan.pcd").write_text("VERSION .7")
    with pytest.raises(CacheError, match=words):
        check_files(tmp_path / name, "graspnet_baseline", {})


def test_keys_and_arrays_that_do_not_exist_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, xyz=np.zeros((10, 3), np.float32))
    with pytest.raises(CacheError, match="no array 'xyzz'"):
        check_files(path, "graspnet_baseline", {"points": "xyzz"})
    with pytest.raises(ConfigError, match="no key 'point'"):
        check_files(path, "graspnet_baseline", {"point": "xyz"})
    with pytest.raises(ConfigError, match="--keys points=NAME"):
        check_files(path, "graspnet_baseline", {})
    (tmp_path / "b.npz").write_bytes(b"PK nothing")
    with pytest.raises(CacheError, match="cannot be read"):
        check_files(tmp_path / "b.npz", "graspnet_baseline", {"points": "xyz"})


def test_the_command_judges_foreign_files(tmp_path, capsys):
    path = tmp_path / "a.npz"
    cloud = correct_batch("graspnet_baseline")["point_clouds"].numpy()
    np.savez(path, xyz=cloud)
    given = ["check", str(path), "--model", "graspnet_baseline", "--keys", "points=xyz", "--unit", "m"]
    assert main([*given, "--frame", "camera", "--json", str(tmp_path / "out.json")]) == 0
    assert json.loads((tmp_path / "out.json").read_text())["verdict"] == "pass"
    assert main([*given, "--frame", "base"]) == 1
    assert "the model works in 'camera'" in capsys.readouterr().out
    assert main([*given[:-4], "--keys", "xyz"]) == 2


def test_the_command_judges_a_built_data_set(tmp_path, capsys):
    made = preset("dp3_sim", frame="base", crop=((-0.3, -0.3, -0.05), (0.3, 0.3, 0.6)))
    source = SyntheticSource(num_scenes=2, size=(120, 160))
    build_dataset(config_from_yaml(made.pipeline.to_yaml()), source, tmp_path / "out")
    assert main(["check", str(tmp_path / "out"), "--model", "dp3_sim", "--frame", "base"]) == 0
    assert main(["check", str(tmp_path / "out"), "--model", "graspnet_baseline"]) == 1
    out = capsys.readouterr().out
    assert "20000" in out
    assert "FAIL" in out


def test_the_models_are_listed_and_shown(capsys):
    assert main(["models"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in CONTRACTS)
    assert main(["models", "rise"]) == 0
    assert "toward zero" in capsys.readouterr().out
    assert main(["models", "rize"]) == 2


@pytest.mark.parametrize("name", CONTRACTS)
def test_the_page_of_a_model_says_what_its_contract_says(name):
    assert (DOCS / f"{name}.md").read_text(encoding="utf-8") == contract_page(CONTRACTS[name])


@pytest.mark.parametrize("name", [name for name in CONTRACTS if "guide" not in name])
def test_every_contract_names_the_commits_that_it_was_held_against(name):
    made = CONTRACTS[name]
    assert made.checked
    for line in made.checked:
        assert re.match(r"[\w-]+/[\w-]+ [0-9a-f]{7} \S+\.(py|yaml)", line), line
        assert f"- {line}\n" in (DOCS / f"{name}.md").read_text(encoding="utf-8")


def test_there_is_a_page_for_every_model_and_no_other():
    assert (DOCS / "README.md").read_text(encoding="utf-8") == index_page()
    pages = {path.stem for path in DOCS.glob("*.md")} - {"README", "wrong_frame"}
    assert pages == set(CONTRACTS)


def test_the_page_on_wrong_frames_quotes_what_was_measured():
    page = (DOCS / "wrong_frame.md").read_text(encoding="utf-8")
    measured = json.loads((DOCS.parents[1] / "benchmarks" / "results" / "train_pointnet.json").read_text())
    for name, row in measured["trainings"].items():
        final = [curve[-1] for curve in row["accuracy"]]
        assert len(final) == measured["seeds"] == 3
        assert (row["mean"], row["worst"]) == (pytest.approx(np.mean(final), abs=1e-4), min(final))
        assert f"| {name} | {row['mean']:.0%} | {row['worst']:.0%} |".replace("%", " %") in page
        assert row["refused"] in page
    assert not measured["trainings"]["base, metres"]["refused"]


def test_arrays_named_as_the_tensors_of_the_model_need_no_keys(tmp_path):
    clouds = np.random.default_rng(0).random((3, 512, 6), np.float32)
    np.savez(tmp_path / "own.npz", point_cloud=clouds, other=np.zeros(3))
    given = {"frame_id": "base", "unit": "m", "frame": "base"}
    told = check_files(tmp_path / "own.npz", "dp3_sim", {}, **given)
    asked = check_files(tmp_path / "own.npz", "dp3_sim", {"point_cloud": "point_cloud"}, **given)
    assert {name: entry.counts for name, entry in told.checks.items()} == {
        name: entry.counts for name, entry in asked.checks.items()
    }
    with h5py.File(tmp_path / "two.h5", "w") as file:  # of two of one name none is taken
        file["a/point_cloud"], file["b/point_cloud"] = clouds, clouds
    with pytest.raises(ConfigError, match="say which array is what"):
        check_files(tmp_path / "two.h5", "dp3_sim", {}, **given)


def test_a_file_that_is_not_there_is_not_called_damaged(tmp_path):
    for name in ("a.npz", "a.npy", "a.h5"):
        with pytest.raises(CacheError, match="no such file") as caught:
            check_files(tmp_path / name, "dp3_sim", {})
        assert "damaged" not in str(caught.value)
