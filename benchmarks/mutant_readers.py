"""Every reader of pcdata by the name of its format."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any


def _depth(pattern: str) -> tuple[str, Callable[[Path], Any]]:
    from pcdata.errors import UnitError
    from pcdata.io import read_depth

    def read(folder: Path) -> Any:
        path = next(folder.glob(pattern))
        try:
            return read_depth(path, metres_per_unit=0.001)
        except UnitError:  # of an image in metres
            return read_depth(path, metres_per_unit=1.0)

    return pattern, read


def _image(kind: str, pattern: str) -> tuple[str, Callable[[Path], Any]]:
    def read(folder: Path) -> Any:
        import pcdata.io

        return getattr(pcdata.io, f"read_{kind}")(next(folder.glob(pattern)))

    return pattern, read


def _capture(pattern: str) -> tuple[str, Callable[[Path], Any]]:
    def read(folder: Path) -> Any:
        from pcdata import open_source

        source = open_source(folder / "cap")
        return [source.load(name) for name in source.ids]

    return pattern, read


def _bag(folder: Path) -> Any:
    from pcdata import open_source

    source = open_source(next(folder.glob("*.bag")))
    return [source.load(name) for name in source.ids[:2]]


def _meta(folder: Path) -> Any:
    from pcdata import open_source

    source = open_source(folder)
    frame = source.load(source.ids[0])
    facts = {key: value for key, value in frame.provenance.items() if key not in ("root", "files")}
    return frame.depth, frame.camera, facts


def _recording(pattern: str) -> tuple[str, Callable[[Path], Any]]:
    def read(folder: Path) -> Any:
        from pcdata import open_source

        source = open_source(next(folder.glob(pattern)))
        frame = source.load(source.ids[0])
        return frame.depth, frame.camera, frame.recorded_signals

    return pattern, read


def _pickle(folder: Path) -> Any:
    from pcdata.io.arrays.plain_pickles import read_plain_pickle

    return read_plain_pickle("pickle", next(folder.glob("*.pkl")).read_bytes())


def _dataset(folder: Path) -> Any:
    from pcdata import CachedCloudDataset

    dataset = CachedCloudDataset(folder / "ds")
    return [dataset[index] for index in range(len(dataset))]


def _told(cloud: Any) -> Any:
    """Return what a cloud holds; its facts may be read only when they are asked."""
    return cloud.points, cloud.colors, cloud.source_index, repr(cloud.meta), cloud.frame_id


def _joined_dataset(folder: Path) -> Any:
    return [*map(_told, _dataset(folder))]


def _store(kind: str, pattern: str) -> tuple[str, Callable[[Path], Any]]:
    """Read what the store alone finds, which no hash of the dataset protects."""

    def read(folder: Path) -> Any:
        from pcdata.io.store.stores import STORES

        store = STORES[kind](folder / "ds" / "shards" / "00000")
        try:
            return [(dict(store.read(key).arrays), store.read(key).info_text()) for key in ("a", "b")]
        finally:
            store.close()

    return f"ds/shards/00000/{pattern}", read


def _at_url(pattern: str) -> tuple[str, Callable[[Path], Any]]:
    """Stream the dataset from a server, which gives its bytes in ranges."""

    def read(folder: Path) -> Any:
        import fsspec

        from pcdata import CachedCloudDataset, StreamedCloudDataset
        from pcdata.io.store import url_dataset

        for known in url_dataset._FETCHED.values():  # the small files too are to be asked for again
            shutil.rmtree(known, ignore_errors=True)
        url_dataset._FETCHED.clear()
        server = fsspec.filesystem("memory")
        server.store.clear()
        server.put(f"{folder / 'ds'}/", "/bucket/set/", recursive=True)
        stream = StreamedCloudDataset(CachedCloudDataset("memory://bucket/set"), batch_size=2, shuffle_buffer=0)
        return [_told(cloud) for batch in stream for cloud in batch]

    return f"ds/{pattern}", read


def _foreign(pattern: str, *names: str) -> tuple[str, Callable[[Path], Any]]:
    """Read the first of the names that the file has."""

    def read(folder: Path) -> Any:
        from pcdata.errors import PcdataError
        from pcdata.io.arrays.stored_arrays import stored_arrays

        path = folder / "a.zarr" if "zarr" in pattern else next(folder.glob(pattern))
        for name in names:
            try:
                with stored_arrays(path, [name]) as arrays:
                    return arrays[name][...]
            except PcdataError:
                if name == names[-1]:
                    raise
        raise AssertionError("no name is given")

    return pattern, read


def _cloud(kind: str) -> tuple[str, Callable[[Path], Any]]:
    def read(folder: Path) -> Any:
        import pcdata

        return getattr(pcdata, f"read_{kind}")(next(folder.glob(f"*.{kind}")))

    return f"*.{kind}", read


def _calibration(folder: Path) -> Any:
    from pcdata import read_calibration

    return read_calibration(folder / "c.yaml")


def _pipeline(folder: Path) -> Any:
    from pcdata import load_config

    return repr(load_config(folder / "p.yaml"))


def _robot(pattern: str) -> tuple[str, Callable[[Path], Any]]:
    def read(folder: Path) -> Any:
        from pcdata.calibration import read_robot_poses

        return read_robot_poses(next(folder.glob(pattern)))

    return pattern, read


def _volume(folder: Path) -> Any:
    from pcdata import read_volume

    return read_volume(folder / "v.npz").extract_points()


READERS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "bag": ("*.bag", _bag),
    "calibration_yaml": ("c.yaml", _calibration),
    "color_jpg": _image("color", "*.jpg"),
    "color_png": _image("color", "*.png"),
    "confidence_png": _image("confidence", "*.png"),
    "dataset_index": ("ds/index/*.npy", _dataset),
    "depth_npy": _depth("*.npy"),
    "depth_png": _depth("*.png"),
    "depth_tiff": _depth("*.tiff"),
    "h5_dataset": ("ds/shards/00000/clouds.h5", _dataset),
    "h5_store": _store("hdf5", "clouds.h5"),
    "h5_foreign": _foreign("*.h5", "pc", "data/pc"),
    "intrinsics_json": _capture("cap/intrinsics.json"),
    "label_png": _image("labels", "*.png"),
    "manifest": ("ds/dataset.json", _dataset),
    "maniskill_h5": _recording("*.h5"),
    "mask_png": _image("mask", "*.png"),
    "meta_mat": ("meta.mat", _meta),
    "npy_foreign": _foreign("*.npy", ""),
    "npz_dataset": ("ds/shards/00000/clouds/*.npz", _dataset),
    "npz_store": _store("npz", "clouds/*.npz"),
    "npz_foreign": _foreign("*.npz", "pc"),
    "pcd_ascii": _cloud("pcd"),
    "pcd_binary": _cloud("pcd"),
    "pcd_binary_compressed": _cloud("pcd"),
    "pickle": ("*.pkl", _pickle),
    "pipeline_yaml": ("p.yaml", _pipeline),
    "packed_dataset": ("ds/shards/00000/clouds.packed", _joined_dataset),
    "packed_store": _store("packed", "clouds.packed"),
    "ply_ascii": _cloud("ply"),
    "ply_binary": _cloud("ply"),
    "ply_binary_big_endian": _cloud("ply"),
    "pose_npy": _capture("cap/poses/*.npy"),
    "pose_txt": _capture("cap/poses/*.txt"),
    "pt_dataset": ("ds/shards/00000/clouds/*.pt", _dataset),
    "pt_store": _store("pt", "clouds/*.pt"),
    "robomimic_hdf5": _recording("*.hdf5"),
    "robot_poses_csv": _robot("*.csv"),
    "robot_poses_yaml": _robot("*.yaml"),
    "shard_table": ("ds/shards/00000/files.tsv", _dataset),
    "timestamps_json": _capture("cap/timestamps.json"),
    "tsdf_npz": ("v.npz", _volume),
    "webdataset_dataset": ("ds/shards/00000/*.tar", _joined_dataset),
    "webdataset_store": _store("webdataset", "*.tar"),
    "webdataset_stream": _at_url("shards/00000/*.tar"),
    "webdataset_url": _at_url("**/*[nvy]"),  # .json, .tsv, .npy: what is fetched when it is opened
    "zarr_foreign": _foreign("a.zarr/data/pc/*", "data/pc"),
}

# Formats that unpack: a small file may stand for much more.
PACKED = {
    "bag", "color_jpg", "color_png", "confidence_png", "depth_png", "depth_tiff", "h5_dataset", "h5_foreign",
    "h5_store", "label_png", "maniskill_h5", "mask_png", "meta_mat", "npz_dataset", "npz_foreign", "npz_store",
    "pcd_binary_compressed", "robomimic_hdf5", "zarr_foreign",
}  # fmt: skip
