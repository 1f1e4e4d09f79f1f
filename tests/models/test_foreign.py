"""Files of anybody: what cannot be judged is refused with a typed error, and never passes."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest

from pcdata.cli import main
from pcdata.errors import CacheError, ConfigError, ContractError, DTypeError, PcdataError, ShapeError
from pcdata.models import check, check_files, require
from pcdata.verdicts import Verdict
from tests.models.captures import correct_batch
from tests.models.test_model_check import failed

GIVEN = {"frame": "base", "frame_id": "base", "unit": "m"}


def arrays() -> dict[str, np.ndarray]:
    """Two clouds of 1024 colored points, and arrays that do not go with them."""
    cloud = correct_batch("dp3_real")["point_cloud"].numpy()
    xyz, rgb = cloud[..., :3], cloud[..., 3:]
    return {
        "xyz": xyz,
        "rgb": rgb,
        "no_samples": xyz[:0],
        "no_points": xyz[:, :0],
        "one_sample": rgb[:1],
        "longer": np.concatenate([rgb, rgb]),
        "fewer_rows": rgb[:, :7],
        "one_cloud": rgb[0],
        "scalar": np.float32(3),
        "text": np.array(["a", "b"]),
        "complex": xyz.astype(np.complex64),
    }


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("foreign")
    np.savez(folder / "a.npz", **arrays())
    with h5py.File(folder / "a.h5", "w") as file:
        for name, array in arrays().items():
            file[name] = array.astype("S1") if name == "text" else array
    return {kind: folder / f"a.{kind}" for kind in ("npz", "h5")}


@pytest.mark.parametrize("kind", ["npz", "h5"])
@pytest.mark.parametrize(
    ("keys", "error", "message"),
    [
        ({"points": "no_samples"}, ShapeError, r"points is \(0, 1024, 3\), so there is nothing to check"),
        ({"points": "no_points"}, ShapeError, r"points is \(2, 0, 3\), so there is nothing to check"),
        ({"point_cloud": "no_samples"}, ShapeError, "point_cloud is .* nothing to check"),
        ({"points": "xyz", "colors": "one_sample"}, ShapeError, r"points is \(2, 1024, 3\) and colors \(1, 1024, 3\)"),
        ({"points": "xyz", "colors": "longer"}, ShapeError, r"points is \(2, 1024, 3\) and colors \(4, 1024, 3\)"),
        ({"points": "xyz", "colors": "fewer_rows"}, ShapeError, r"\(2, 1024, 3\) and colors \(2, 7, 3\)"),
        ({"points": "xyz", "colors": "one_cloud"}, ShapeError, r"\(2, 1024, 3\) and colors \(1024, 3\)"),
        ({"points": "scalar"}, ShapeError, r"must be \(points, channels\) or .*, got \(\)"),
        ({"point_cloud": "scalar"}, ShapeError, r"point_cloud must be \(B, N, C\), got \(\)"),
        ({"points": "text"}, DTypeError, "text: must hold numbers, got"),
        ({"points": "complex"}, DTypeError, "complex: must hold numbers, got complex64"),
        ({"points": "xyz", "normals": "xyz"}, ConfigError, "dp3_real: takes no normals"),
        ({"point_cloud": "xyz", "colors": "rgb"}, ConfigError, "not both"),
    ],
)
def test_arrays_that_make_no_sample_are_refused_with_where_and_what(files, kind, keys, error, message):
    with pytest.raises(error, match=message) as caught:
        check_files(files[kind], "dp3_real", keys, **GIVEN)
    if error is not ConfigError:
        assert str(files[kind]) in str(caught.value)


def test_the_command_says_so_in_one_line_and_fails(files, capsys):
    given = ["check", str(files["npz"]), "--model", "dp3_real", "--frame", "base", "--unit", "m", "--keys"]
    for keys in ("points=no_samples", "points=xyz,colors=longer", "points=text", "points=scalar"):
        assert main([*given, keys]) == 1
        printed = capsys.readouterr()
        assert printed.out == ""
        assert printed.err.startswith("pcdata: ")
        assert printed.err.count("\n") == 1


@pytest.mark.parametrize("nothing", [[], (), iter(())])
def test_no_samples_are_no_pass(nothing):
    with pytest.raises(ContractError, match=r"nothing to judge: .* 0 samples"):
        check(nothing, "dp3_sim")
    with pytest.raises(ContractError, match="nothing to judge"):
        require([], "dp3_sim")
    with pytest.raises(ContractError, match="nothing to judge"):
        check([correct_batch("dp3_sim")], "dp3_sim", limit=0)


def test_arrays_of_objects_in_a_mapping_fail_by_name():
    summary = check({"point_cloud": np.array([{"x": 1}])}, "dp3_sim")
    assert failed(summary) == {"channels"}
    assert "point_cloud: must hold numbers, got object" in summary.checks["channels", None].worst.found


def damaged(folder: Path) -> dict[str, Path]:
    """Files that are cut short, hold objects, or claim more than they have."""
    points = np.random.default_rng(0).random((2, 1024, 3), np.float32)
    np.savez(folder / "whole.npz", xyz=points)
    with h5py.File(folder / "whole.h5", "w") as file:
        file["xyz"] = points
    for kind in ("npz", "h5"):
        (folder / f"cut.{kind}").write_bytes((folder / f"whole.{kind}").read_bytes()[:5000])
        (folder / f"empty.{kind}").write_bytes(b"")
    np.savez(folder / "objects.npz", xyz=np.array([{"a": 1}], dtype=object))
    flipped = bytearray((folder / "whole.npz").read_bytes())
    flipped[9000] ^= 255
    (folder / "flipped.npz").write_bytes(flipped)
    header = b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '<f4', 'fortran_order': False, 'shape': (900000000, 1024, 3), }"
    for name, content in (("claims", header.ljust(127) + b"\n" + bytes(48)), ("noise", b"no npy at all")):
        with zipfile.ZipFile(folder / f"{name}.npz", "w") as archive:
            archive.writestr("xyz.npy", content)
    (folder / "claims.npy").write_bytes(header.ljust(127) + b"\n" + bytes(48))
    (folder / "plain.txt").write_text("1 2 3")
    return {path.name: path for path in folder.iterdir() if "whole" not in path.name}


def test_damaged_and_hostile_files_are_typed_errors_that_name_the_file(tmp_path):
    for name, path in damaged(tmp_path).items():
        with pytest.raises(PcdataError) as caught:
            check_files(path, "dp3_real", {"points": "" if name.endswith(".npy") else "xyz"}, **GIVEN)
        assert isinstance(caught.value, (CacheError, ValueError)), name
        assert name in str(caught.value)
    with pytest.raises(CacheError, match="never unpickled"):
        check_files(tmp_path / "objects.npz", "dp3_real", {"points": "xyz"}, **GIVEN)
    with pytest.raises(CacheError, match="no such file"):
        check_files(tmp_path / "none.npz", "dp3_real", {"points": "xyz"}, **GIVEN)


def test_packed_zeros_that_would_fill_the_memory_are_not_unpacked(tmp_path):
    rows = 300_000_000 // 12
    packed = zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED)
    with packed as archive, archive.open("xyz.npy", "w") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": (1, rows, 3)})
        for _ in range(3):
            stream.write(bytes(rows * 4))
    with h5py.File(tmp_path / "bomb.h5", "w") as file:
        file.create_dataset("xyz", (1, rows, 3), "<f4", chunks=(1, rows, 3), compression="gzip", fillvalue=1)
    folder = tmp_path / "bomb" / "xyz"
    folder.mkdir(parents=True)
    header = {"zarr_format": 2, "shape": [1, 10**12, 3], "chunks": [1, 1000, 3], "dtype": "<f4", "order": "C"}
    header |= {"compressor": None, "filters": None, "fill_value": 0}
    (folder / ".zarray").write_text(json.dumps(header))
    for name in ("bomb.npz", "bomb.h5", "bomb"):
        with pytest.raises(CacheError, match="claims") as caught:
            check_files(tmp_path / name, "dp3_real", {"points": "xyz"}, **GIVEN)
        assert name in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        {"shape": ["a", 3]},
        {"shape": [-1, 3]},
        {"chunks": [2**20, 2**20]},
        {"fill_value": "x"},
        {"compressor": {"level": 1}},
        {"compressor": {"id": "zlib"}},
        {"order": "Z"},
        {"dtype": "|O"},
        {"dtype": "<U4"},
        {"dtype": "nothing"},
    ],
)
def test_hostile_zarr_headers_are_typed_errors(tmp_path, change):
    header = {"zarr_format": 2, "shape": [4, 3], "chunks": [2, 3], "dtype": "<f4", "order": "C"}
    header |= {"compressor": None, "filters": None, "fill_value": 0, **change}
    (tmp_path / "xyz").mkdir()
    (tmp_path / "xyz" / ".zarray").write_text(json.dumps(header))
    (tmp_path / "xyz" / "0.0").write_bytes(bytes(24))
    with pytest.raises(PcdataError):
        check_files(tmp_path, "dp3_real", {"points": "xyz"}, **GIVEN)


def test_colors_that_a_model_takes_as_a_tensor_of_its_own_are_made_by_role(tmp_path):
    batch = correct_batch("anygrasp")
    count = batch.counts[0]
    np.savez(tmp_path / "a.npz", p=batch["points"][:count].numpy(), c=batch["colors"][:count].numpy())
    keys = {"points": "p", "colors": "c"}
    summary = check_files(tmp_path / "a.npz", "anygrasp", keys, frame_id="camera", unit="m")
    assert summary.verdict is Verdict.PASS


def test_a_category_and_other_choices_are_given_to_the_command(tmp_path, capsys):
    batch = correct_batch("pointnet_part")
    np.savez(tmp_path / "a.npz", p=batch["pointclouds_ph"].numpy())
    given = ["check", str(tmp_path / "a.npz"), "--model", "pointnet_part", "--keys", "points=p", "--frame", "base"]
    assert main([*given, "--unit", "normalized", "--set", "category=3"]) == 0
    assert main([*given, "--unit", "normalized"]) == 1
    assert "no tensor 'input_label_ph'" in capsys.readouterr().out
    assert main([*given, "--set", "category=99"]) == 2
    assert main([*given, "--num-points", "2048", "--set", "num_points=2048"]) == 2
    assert "given twice" in capsys.readouterr().err
