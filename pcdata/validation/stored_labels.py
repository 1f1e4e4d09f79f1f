"""Labels of objects in the samples of a built dataset, brought to the pixels of their true labels."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import torch

from pcdata.errors import CaptureError, ShapeError
from pcdata.structures import PointCloud
from pcdata.validation.label_files import LabelFile, files_by_name


def labels_of_sample(cloud: PointCloud, where: Path, true: LabelFile) -> LabelFile:
    """Return the object of every pixel that a stored cloud has a point of; what was left out of it is no object.

    Args:
        cloud: a sample as it was stored; its clouds, where it has several, are of one capture.
        where: the sample, for messages.
        true: what it will be compared with.

    Raises:
        CaptureError: the sample has no labels, or does not know its pixels.
        ShapeError: it is of several views or of another image, or points of its objects were left out later.
    """
    if cloud.labels is None:
        raise CaptureError(f"labels_of_sample: {where} has no labels; build it with ClusterObjects")
    if cloud.source_index is None:
        raise CaptureError(
            f"labels_of_sample: {where} does not know its pixels: a step averaged points, as VoxelDownsample does; "
            "build without the steps after ClusterObjects"
        )
    meta = cloud.meta[0]
    known, now = sum(int(one["points"]) for one in meta.get("objects", ())), int((cloud.labels >= 0).sum())
    if now < known:
        raise ShapeError(
            f"labels_of_sample: {where} has {now} of the {known} points of its objects, and pixels without a point "
            "would count as missed: a step after ClusterObjects thins it out; build without such steps, as "
            "FarthestPointSample"
        )
    if true.size is None:
        rows = torch.arange(len(cloud.labels), dtype=torch.int64, device="cpu")
        return LabelFile(where, cloud.labels, rows, None)
    sizes = [tuple(one["size"]) for one in meta.get("cameras", ())]
    if len(sizes) > 1:
        raise ShapeError(
            f"labels_of_sample: {where} is merged of {len(sizes)} views, and {true.path} is one image; "
            "label_image(cloud, view=..., size=...) gives the labels of each view"
        )
    size = sizes[0] if sizes else tuple(meta.get("organized_size", true.size))
    if size != true.size or (len(cloud.source_index) and int(cloud.source_index.max()) >= size[0] * size[1]):
        raise ShapeError(
            f"labels_of_sample: {where} is of an image of {size[1]}x{size[0]} but {true.path} is one of "
            f"{true.size[1]}x{true.size[0]}; give the true labels at the pixels of the capture"
        )
    return LabelFile(where, cloud.labels, cloud.source_index, true.size)


def paired_samples(
    ids: Sequence[str], dataset: str | os.PathLike[str], true: str | os.PathLike[str]
) -> list[tuple[str, Path]]:
    """Return (id, true file) of every sample of a dataset; a file goes with the only sample.

    Raises:
        CaptureError: a sample has no file of its name, or a file no sample.
    """
    path = Path(true)
    if not path.exists():
        raise CaptureError(f"{path} does not exist")
    if not path.is_dir():
        if len(ids) != 1:
            raise CaptureError(f"{dataset} has {len(ids)} samples and {path} is one file; give a folder of such files")
        return [(ids[0], path)]
    files = files_by_name(path)
    for names, others, folder, what in ((ids, files, path, "label file"), (files, set(ids), dataset, "sample")):
        if alone := [name for name in names if name not in others]:
            more = f" and {len(alone) - 3} more" if len(alone) > 3 else ""
            raise CaptureError(f"{folder} has no {what} named {', '.join(alone[:3])}{more}; each needs its partner")
    return [(name, files[name]) for name in ids]


__all__ = ["labels_of_sample", "paired_samples"]
