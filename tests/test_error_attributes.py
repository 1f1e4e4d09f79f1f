"""Errors say where they happened in attributes, beside their words: step, sample id, path; from workers too."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
from torch.utils.data import DataLoader

import pcdata
from pcdata import CachedCloudDataset, CloudDataset, build_dataset, collate_packed
from pcdata.build.config import config_from_yaml
from pcdata.errors import CaptureError, PcdataError, TooFewPointsError, locate
from pcdata.io.store.manifest import Manifest
from pcdata.io.store.stores import STORES
from pcdata.synthetic import SyntheticSource
from pcdata.transforms import Compose, Deproject, MaskDepth, Transform
from tests.io.forged import first_shard

FAILING = "depth: [MaskDepth: {near: 5.0, far: 6.0}, Deproject]"


@pytest.fixture(scope="module")
def source() -> SyntheticSource:
    return SyntheticSource(num_scenes=2, size=(24, 32))


class LooksUp(Transform, abstract=True):
    """Raises what others raise."""

    def transform(self, cloud, params):
        raise KeyError("nothing here")


def place(error: BaseException) -> tuple[str | None, str | None]:
    return error.step, error.sample_id


def test_a_failing_step_of_a_build_is_named_with_its_sample(source, tmp_path):
    with pytest.raises(TooFewPointsError) as caught:
        build_dataset(config_from_yaml(FAILING), source, tmp_path / "out")
    assert place(caught.value) == ("Deproject", source.ids[0])


@pytest.mark.filterwarnings("ignore:This DataLoader will create")
@pytest.mark.parametrize(
    ("num_workers", "steps", "kind", "step"),
    [
        (0, [MaskDepth(near=5.0, far=6.0), Deproject()], TooFewPointsError, "Deproject"),
        (1, [MaskDepth(near=5.0, far=6.0), Deproject()], TooFewPointsError, "Deproject"),
        (1, [Deproject(), LooksUp()], KeyError, "LooksUp"),
    ],
)
def test_what_fails_in_a_worker_reaches_the_parent_with_its_place(source, num_workers, steps, kind, step):
    dataset = CloudDataset(source, Compose(steps=steps))
    context = "fork" if num_workers else None
    loader = DataLoader(
        dataset, sampler=[1], num_workers=num_workers, collate_fn=collate_packed, multiprocessing_context=context
    )
    with pytest.raises(kind) as caught:
        next(iter(loader))
    assert place(caught.value) == (step, source.ids[1])
    assert "\\n" not in str(caught.value), "a text in one line, with escapes, cannot be read"
    again = pickle.loads(pickle.dumps(caught.value))
    assert isinstance(again, kind)
    assert place(again) == (step, source.ids[1])


@pytest.mark.parametrize("format", ["hdf5", "npz", "packed", "pt", "webdataset"])
def test_a_broken_file_of_a_dataset_is_named(source, tmp_path, format):
    config = config_from_yaml(f"depth: [Deproject]\noutput: {{format: {format}}}")
    build_dataset(config, source, tmp_path / "out")
    store = STORES[format](first_shard(tmp_path / "out"))
    broken = store.path_of(Manifest.read(tmp_path / "out").samples[1].key)
    broken.write_bytes(broken.read_bytes()[:100])
    dataset = CachedCloudDataset(tmp_path / "out")
    with pytest.raises(PcdataError) as caught:
        dataset[1]
    assert caught.value.path == str(broken)
    assert caught.value.sample_id == source.ids[1]


@pytest.mark.parametrize(
    ("name", "reader"),
    [
        ("a.png", "read_depth"),
        ("a.png", "read_color"),
        ("a.png", "read_labels"),
        ("a.png", "read_mask"),
        ("a.png", "read_confidence"),
        ("a.pcd", "read_pcd"),
        ("a.ply", "read_ply"),
        ("a.txt", "read_pose"),
        ("a.json", "read_intrinsics"),
        ("a.json", "read_capture_camera"),
        ("a.yaml", "read_calibration"),
        ("a.npz", "read_volume"),
    ],
)
@pytest.mark.parametrize("content", [None, b"", b"\x00 no such file"])
def test_a_broken_file_is_named_whoever_reads_it(tmp_path, name, reader, content):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    options = {"read_depth": {"metres_per_unit": 0.001}, "read_intrinsics": {"size": (4, 4)}}.get(reader, {})
    with pytest.raises(PcdataError) as caught:
        getattr(pcdata.io, reader)(path, **options)
    assert caught.value.path == str(path)


def test_a_broken_capture_is_named_with_its_file(tmp_path):
    frame = SyntheticSource(num_scenes=1, size=(24, 32)).load("tabletop-0000").view(0)
    pcdata.io.write_capture(frame, tmp_path)
    opened = pcdata.open_source(tmp_path / "view0")
    (depth,) = opened.depth_files(opened.ids[0])
    Path(depth).write_bytes(b"none")
    with pytest.raises(CaptureError) as caught:
        opened.load(opened.ids[0])
    assert (caught.value.sample_id, caught.value.path) == (opened.ids[0], str(depth))


def test_the_innermost_step_and_file_and_the_outermost_sample_are_kept():
    error = CaptureError("no")
    locate(error, step="Inner", path="inner.png", sample_id="0")
    locate(error, step="Outer", path="folder", sample_id="left/0")
    assert (error.step, error.path, error.sample_id) == ("Inner", "inner.png", "left/0")
    assert (CaptureError("other").step, CaptureError.path) == (None, None)
