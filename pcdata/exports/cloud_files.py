"""Clouds as files of other programs: one PLY or PCD a sample, of captures, cloud files or a built dataset."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pcdata.datasets import CachedCloudDataset
from pcdata.errors import CacheError, ConfigError, PcdataError, add_note, near_matches, write_fault
from pcdata.files.whole_folders import complete_or_nothing
from pcdata.io.clouds.pcd import write_pcd
from pcdata.io.clouds.ply import write_ply
from pcdata.io.sources.capture_source import check_apart, checked_ids
from pcdata.io.writers.file_names import file_names
from pcdata.progress import Progress
from pcdata.structures import DepthFrame, PointCloud
from pcdata.transforms import Compose, Deproject, MergeViews, ToFrame

_WHERE = "write_clouds"
_FORMATS: dict[str, Any] = {"ply": write_ply, "pcd": write_pcd}
_OF_PLY = ("scalar_names", "quality")


def clouds_of(data: DepthFrame | PointCloud) -> list[PointCloud]:
    """Return the single clouds of a sample: of depth images all views in one, in the frame of their poses.

    Without poses every view is a cloud of its own, in its camera's frame.
    """
    if isinstance(data, PointCloud):
        return data.unbatch()
    steps: list[Any] = [Deproject()]
    if data.frame_id is not None:
        steps += [ToFrame(frame=data.frame_id), MergeViews()]
    return list(Compose(steps)(data).unbatch())


def write_clouds(
    source: Any,
    out: str | os.PathLike[str],
    *,
    to: str = "ply",
    encoding: str = "binary",
    scalar_names: bool = False,
    quality: str | None = None,
    progress: Progress | None = None,
) -> int:
    """Write every sample as a file of CloudCompare, MeshLab or PCL; return how many files.

    The folder appears when all are there. Files are called as their samples; views without poses, which are clouds of
    their own, ``NAME_view0`` and so on.

    Args:
        source: captures or clouds, such as :func:`pcdata.open_source` gives; or a :class:`CachedCloudDataset`.
        out: the folder, which is new, and not inside the captures.
        to: "ply" or "pcd".
        encoding: of the format, see :func:`pcdata.write_ply` and :func:`pcdata.write_pcd`.
        scalar_names: of PLY, as :func:`pcdata.write_ply` has it.
        quality: likewise.
        progress: called after every sample.

    Raises:
        ConfigError: no such format, or an option that it does not have.
        CacheError: the folder exists, or cannot be written.
        PcdataError: a sample cannot be read or written.
    """
    if to not in _FORMATS:
        raise ConfigError(f"{_WHERE}: clouds are written as {' or '.join(_FORMATS)}{near_matches(to, _FORMATS)}")
    options: dict[str, Any] = {"encoding": encoding}
    options |= {name: value for name, value in (("scalar_names", scalar_names), ("quality", quality)) if value}
    if to != "ply" and (strange := [name for name in _OF_PLY if name in options]):
        raise ConfigError(f"{_WHERE}: {to} has no {strange[0]}, since it keeps every field by its name; leave it out")
    folder = Path(os.path.realpath(Path(out).expanduser()))
    check_apart(_WHERE, folder, source.folder if isinstance(source, CachedCloudDataset) else source)
    ids = list(source.ids) if isinstance(source, CachedCloudDataset) else checked_ids(_WHERE, source)
    written = 0
    names = file_names(ids)
    taken = {name.casefold() for name in names}
    with complete_or_nothing(folder) as partial:
        for done, (sample_id, name) in enumerate(zip(ids, names, strict=True), 1):
            try:
                for place, cloud in _named(source, sample_id, done - 1, name, taken):
                    _FORMATS[to](partial / f"{place}.{to}", cloud, **options)
                    written += 1
            except PcdataError as error:
                error.args = (str(error).replace(str(partial), str(folder)), *error.args[1:])  # as it would be called
                add_note(error, f"sample {sample_id!r}", sample_id=sample_id)
                raise
            except OSError as error:
                raise CacheError(f"{folder}: cannot be written: {write_fault(error)}") from error
            if progress is not None:
                progress(done, len(ids), sample_id)
    return written


def _named(source: Any, sample_id: str, number: int, name: str, taken: set[str]) -> Iterator[tuple[str, PointCloud]]:
    """Load a sample; return its clouds by the names of their files, and take those that no other may have."""
    data = source[number] if isinstance(source, CachedCloudDataset) else source.load(sample_id).cpu()
    clouds = clouds_of(data)
    if len(clouds) == 1:  # the name of the sample, taken from the start
        yield name, clouds[0]
        return
    for part, cloud in zip(_parts(clouds), clouds, strict=True):
        place = name + part
        while place.casefold() in taken:  # another sample is called so
            place = f"{name}_{place[len(name) :]}"
        taken.add(place.casefold())
        yield place, cloud


def _parts(clouds: Sequence[PointCloud]) -> list[str]:
    """Say what each cloud is of a sample: a view of it, or an object of SplitObjects by its label, or one of a view."""
    objects = [found for cloud in clouds if (found := _object_of(cloud)) is not None]
    if len(objects) < len(clouds):
        return [f"_view{view}" for view in range(len(clouds))]
    views = list(itertools.accumulate((rank == 0 for _, rank in objects[1:]), initial=0))
    return [
        f"_view{view}_object{label}" if views[-1] else f"_object{label}"
        for view, (label, _) in zip(views, objects, strict=True)
    ]


def _object_of(cloud: PointCloud) -> tuple[int, int] | None:
    """Return the label of the object that SplitObjects made a cloud of, and its place among those of its view."""
    for step in reversed(cloud.history[0]):
        if step["step"] == "SplitObjects":
            params = step.get("params", {})
            label, rank = params.get("label"), params.get("rank")
            return (label, rank) if isinstance(label, int) and isinstance(rank, int) else None
    return None
