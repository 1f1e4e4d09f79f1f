"""JSON that says nothing certain is refused at every door: captures, datasets, exports, clouds, volumes, zarr."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pcdata import Camera, DepthFrame, PointCloud, TSDFVolume, read_ply, read_volume, write_ply, write_volume
from pcdata.errors import CacheError, CaptureError, PcdataError
from pcdata.exports.export_record import FILE_NAME, ExportRecord
from pcdata.files.npz import write_npz
from pcdata.files.strict_json import json_object, json_text, parse_json
from pcdata.io.arrays.stored_arrays import stored_arrays
from pcdata.io.store.cloud_record import Record, cloud_from_record, parse_info, record_from_cloud
from pcdata.io.store.manifest import Manifest

WRONG = {
    "nesting": "[" * 100_000,
    "objects in objects": '{"a":' * 100_000,
    "closed nesting": '{"a": ' + "[" * 101 + "]" * 101 + "}",
    "brackets": '{"a": [' + "{}," * 100_000 + "{}]}",
    "a name twice": '{"a": 1, "a": 2}',
    "a name twice inside": '{"a": {"b": 1, "b": 2}}',
    "not a number": '{"a": NaN}',
    "no end": '{"a": Infinity}',
    "beyond a float": '{"a": 1e999}',
    "far below a float": '{"a": [2, -1.5E+0309]}',
    "beyond a float by its digits": '{"a":' + "7" * 250 + "e60}",
    "beyond a float in UTF-16": '{"a":1e999}'.encode("utf-16"),
    "four hundred digits and a point": '{"a": ' + "1" * 400 + ".0}",
    "five thousand digits": '{"a": ' + "1" * 5000 + "}",
    "a list": "[1]",
    "nothing": "",
    "half": '{"a": ',
    "NUL": '{"a": "\0"}',
    "bytes that are no UTF-8": b'{"a": "\xff"}',
    "a long name twice": f'{{"{"a" * 9000}": 1, "{"a" * 9000}": 1}}',
}


@pytest.mark.parametrize("name", WRONG)
def test_json_that_says_nothing_certain_is_refused(name):
    with pytest.raises(CaptureError, match="here: ") as caught:
        json_object("here", WRONG[name], error=CaptureError)
    assert len(str(caught.value)) < 1000
    with pytest.raises(CacheError):
        parse_info(WRONG[name])


def test_what_only_looks_like_a_large_number_is_read():
    text = '{"a": ["1e999", "x 1e999", 1e308, 1e-999, -2E+0007], "b": ' + "1" * 400 + ', "5e123": 3}'
    assert parse_json(text) == {"a": ["1e999", "x 1e999", 1e308, 0.0, -2e7], "b": int("1" * 400), "5e123": 3}


def test_plain_json_is_read():
    text = '{"a": [1, 2.5, null, true, "x"], "b": {"c": -3}}'
    assert json_object("here", text, error=CaptureError) == {"a": [1, 2.5, None, True, "x"], "b": {"c": -3}}
    deep = "[" * 100 + "]" * 100
    assert json.dumps(parse_json(deep)) == deep


# A valid text, and the same with a name given twice, a number that is none, and levels without end.
EDITS: dict[str, Callable[[str], str]] = {
    "twice": lambda text: text.rstrip().removesuffix("}") + f", {text.strip()[1 : text.strip().index(':')]}: 1}}",
    "nan": lambda text: text.rstrip().removesuffix("}") + ', "more": NaN}',
    "deep": lambda text: text.rstrip().removesuffix("}") + ', "more": ' + "[" * 300 + "]" * 300 + "}",
}


def facts(folder: Path, edit: Callable[[str], str]) -> Any:
    record = record_from_cloud(PointCloud(points=torch.rand(4, 3), frame_id="base"))
    return cloud_from_record(Record(record.arrays, parse_info(edit(record.info_text()))))


def manifest(folder: Path, edit: Callable[[str], str]) -> Any:
    whole = {"schema": "pcdata.dataset/2", "samples": []}
    (folder / "dataset.json").write_text(edit(json.dumps(whole)))
    return Manifest.read(folder)


def export(folder: Path, edit: Callable[[str], str]) -> Any:
    ExportRecord("ggcnn", {}, "folder", ["a"], True).write(folder)
    path = folder / FILE_NAME
    path.write_text(edit(path.read_text()))
    return ExportRecord.read(folder)


def zarr(folder: Path, edit: Callable[[str], str]) -> Any:
    head = {"zarr_format": 2, "shape": [2], "chunks": [2], "dtype": "<f4", "order": "C", "fill_value": 0}
    (folder / ".zarray").write_text(edit(json.dumps({**head, "compressor": None, "filters": None})))
    (folder / "0").write_bytes(bytes(8))
    with stored_arrays(folder, [""]) as arrays:
        return arrays[""][...]


def volume(folder: Path, edit: Callable[[str], str]) -> Any:
    path = folder / "v.npz"
    camera = Camera.pinhole(fx=20.0, fy=20.0, cx=1.5, cy=1.5, size=(4, 4))
    pose = torch.eye(4, dtype=torch.float64)[None]
    frame = DepthFrame(depth=torch.ones(1, 4, 4), camera=camera, world_from_camera=pose, frame_id="base")
    volume = TSDFVolume(voxel_size=0.05, truncation=0.15)
    volume.integrate(frame)
    write_volume(path, volume)
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    arrays["about"] = np.frombuffer(edit(arrays["about"].tobytes().decode()).encode(), np.uint8)
    with path.open("wb") as file:
        write_npz(file, arrays)
    return read_volume(path)


DOORS = {"facts": facts, "manifest": manifest, "export": export, "zarr": zarr, "volume": volume}
SAID = {"twice": "given twice", "nan": "NaN is not a finite number", "deep": "nested too deeply"}


@pytest.mark.parametrize("edit", EDITS)
@pytest.mark.parametrize("door", DOORS)
def test_every_door_refuses_it(tmp_path, door, edit):
    if door not in ("manifest", "zarr"):  # of which this one has no samples, or has other tests
        DOORS[door](tmp_path, str)
    with pytest.raises(PcdataError, match=SAID[edit]):
        DOORS[door](tmp_path, EDITS[edit])


def test_a_comment_of_a_cloud_is_read_as_strictly(tmp_path):
    path = tmp_path / "a.ply"
    write_ply(path, PointCloud(points=torch.rand(4, 3), frame_id="base"))
    assert read_ply(path).frame_id == "base"
    text = path.read_bytes()
    start = text.index(b"comment pcdata viewpoint")
    path.write_bytes(text[:start] + b"comment pcdata viewpoint [NaN, 0, 0]" + text[text.index(b"\n", start) :])
    with pytest.raises(CaptureError, match="NaN is not a finite number"):
        read_ply(path)


def test_what_could_not_be_read_back_is_not_written():
    deep: Any = 1
    for _ in range(200):
        deep = [deep]
    with pytest.raises(CacheError, match="nested too deeply"):
        record_from_cloud(PointCloud(points=torch.rand(4, 3), frame_id="base", meta=({"deep": deep},)))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a\udcff\udc80", r"a\xff\x80"),  # bytes that are no UTF-8
        ("\ud83d", r"\ud83d"),
        ("\ud83dx\ude00", r"\ud83dx\ude00"),
        ("\\\udc80", r"\\x80"),
        ("\\udcff", "\\udcff"),  # a backslash and letters, no surrogate
        ("\\\\udcff", "\\\\udcff"),
        ("\U0001f600\u00e9\u202e\x1b", "\U0001f600\u00e9\u202e\x1b"),
    ],
)
def test_json_that_is_written_has_no_half_characters(text, told):
    written = json_text({text: [text]}, indent=1)
    assert written.isascii()
    assert json.loads(written) == {told: [told]}
    told.encode()


def test_json_that_is_written_has_finite_numbers_alone():
    with pytest.raises(ValueError, match="not JSON compliant"):
        json_text([float("nan")])


@pytest.mark.parametrize("text", [r'{"frame_id": "a\ud800"}', r'{"a\uDCFF": 1}', rb'{"a": "\udc80\ud83d"}'])
def test_half_a_character_is_refused_in_what_others_wrote(text):
    with pytest.raises(CaptureError, match="half a character"):
        json_object("it", text, error=CaptureError)
    assert json_object("it", text, error=CacheError)  # a dataset says so where its captures lie
    json_object("it", r'{"\ud83d\ude00": "\\ud800"}', error=CaptureError)
