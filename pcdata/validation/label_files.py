"""Labels of objects in files: images and clouds, brought to the same pixels or rows so that they can be compared."""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from pcdata.errors import CaptureError, ConfigError, ShapeError
from pcdata.io import read_labels, read_pcd, read_ply

IMAGES = (".png",)
CLOUDS = (".pcd", ".ply")


@dataclass(frozen=True)
class LabelFile:
    """The labels that a file holds.

    Args:
        path: the file.
        labels: (M,) int64, -1 = no object.
        place: (M,) int64, the pixel or the row of the file that each belongs to; what has no reading has no label.
        size: (height, width) where places are pixels.
        unscored: (M,) bool, what counts for neither, as nobody knows its object; None = nothing.
    """

    path: Path
    labels: Tensor
    place: Tensor
    size: tuple[int, int] | None
    unscored: Tensor | None = None


def read_label_file(
    path: str | os.PathLike[str],
    *,
    background: Collection[int] | None = None,
    ignore: Collection[int] = (),
    parts: int | None = None,
) -> LabelFile:
    """Read the object of every pixel of a label image, or of every point of a cloud.

    Args:
        path: an 8-bit, 16-bit or palette PNG, or a PCD or PLY with a field of labels.
        background: labels that are no object, such as the table's, beside negative ones; None = 0 in images and where
            parts are joined, none in clouds, whose first object pcdata calls 0.
        ignore: labels of what is not to be scored, such as a robot's or that of all that nobody labeled.
        parts: objects are labeled in parts: the label divided by this, without the rest, is the object.

    Raises:
        CaptureError: the file cannot be read, or a cloud has no labels.
        ConfigError: the name ends otherwise, or parts is less than 2.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if parts is not None and parts < 2:
        raise ConfigError(f"read_label_file: parts must be at least 2, got {parts}")
    size: tuple[int, int] | None
    if suffix in IMAGES:
        image = read_labels(path)
        size = (image.shape[0], image.shape[1])
        labels, place = image.reshape(-1), torch.arange(image.numel(), dtype=torch.int64, device="cpu")
    elif suffix in CLOUDS:
        cloud = (read_pcd if suffix == ".pcd" else read_ply)(path)
        if cloud.labels is None:
            raise CaptureError(f"read_label_file: {path} has no labels; write the cloud after ClusterObjects")
        assert cloud.source_index is not None  # readers give the rows of the file
        labels, place = cloud.labels, cloud.source_index
        height, width = cloud.meta[0].get("organized_size", (0, 0))
        size = (height, width) if height else None
    else:
        raise ConfigError(
            f"read_label_file: {path} must end in {', '.join(IMAGES + CLOUDS)}: an image of labels, or a cloud"
        )
    if parts is not None:
        labels = torch.where(labels < 0, labels, labels.div(parts, rounding_mode="floor"))
    if background is None:
        background = (0,) if suffix in IMAGES or parts is not None else ()
    none, unscored = (
        torch.isin(labels, torch.tensor(sorted(listed), dtype=torch.int64, device="cpu"))
        for listed in (background, ignore)
    )
    labels = torch.where((labels < 0) | none | unscored, -1, labels)
    return LabelFile(path, labels, place, size, unscored if ignore else None)


def matched_labels(predicted: LabelFile, true: LabelFile) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return predicted and true labels of the same pixels (H, W) or rows (N,), and which of them are not scored.

    A cloud without pixels goes with the readings of an organized one, in its order, as it does where it was read from
    that file and kept whole.

    Raises:
        ShapeError: the two are not of the same pixels or rows.
    """
    place = predicted.place
    if predicted.size != true.size or (true.size is None and len(place) != len(true.place)):
        if predicted.size is not None or len(place) != len(true.place):
            raise ShapeError(
                f"matched_labels: {predicted.path} has {_told(predicted)} but {true.path} has {_told(true)}; give "
                "predictions at the pixels of the truth, such as label_image(cloud) or the dataset that a build wrote, "
                "or for every point of it, in its order"
            )
        place = true.place
    if true.size is None:
        return predicted.labels, true.labels, true.unscored
    height, width = true.size
    guess, truth = (torch.full((height * width,), -1, dtype=torch.int64, device="cpu") for _ in range(2))
    guess[place], truth[true.place] = predicted.labels, true.labels
    blank = torch.ones(height * width, dtype=torch.bool, device="cpu")
    blank[true.place] = False if true.unscored is None else true.unscored
    return guess.reshape(true.size), truth.reshape(true.size), blank.reshape(true.size)


def paired_files(predicted: str | os.PathLike[str], true: str | os.PathLike[str]) -> list[tuple[str, Path, Path]]:
    """Return (name, predicted file, true file) of two files, or of all files of two folders that share a name.

    Folders are searched to any depth; the name is the path in the folder without its suffix.

    Raises:
        CaptureError: one is missing, the folders have no label file, or a prediction or a truth has no partner: a
            score over part of the scenes would not say so.
        ConfigError: one is a file and the other a folder.
    """
    first, second = Path(predicted), Path(true)
    for path in (first, second):
        if not path.exists():
            raise CaptureError(f"{path} does not exist")
    if first.is_dir() != second.is_dir():
        raise ConfigError(f"give two files or two folders; of {first} and {second} one is a folder")
    if not first.is_dir():
        return [(second.stem, first, second)]
    found = [files_by_name(folder) for folder in (first, second)]
    names = [set(files) for files in found]
    for one, other, folder in ((0, 1, second), (1, 0, first)):
        if alone := sorted(names[one] - names[other]):
            more = f" and {len(alone) - 3} more" if len(alone) > 3 else ""
            raise CaptureError(f"{folder} has no label file named {', '.join(alone[:3])}{more}; each needs its partner")
    if not names[0]:
        raise CaptureError(f"{first} and {second} have no label files ({', '.join(IMAGES + CLOUDS)})")
    return [(name, found[0][name], found[1][name]) for name in sorted(names[0], key=_natural)]


def files_by_name(folder: Path) -> dict[str, Path]:
    """Return the label files of a folder, at any depth, by their paths in it without the suffix.

    Raises:
        CaptureError: two have the same name.
    """
    files: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() not in IMAGES + CLOUDS or not path.is_file():
            continue
        name = path.relative_to(folder).with_suffix("").as_posix()
        if name in files:
            raise CaptureError(f"{folder}: {files[name].name} and {path.name} have the same name; leave one of them")
        files[name] = path
    return files


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort scene2 before scene10."""
    words, digits = [], ""
    for character in name + " ":
        if character.isdecimal():
            digits += character
            continue
        if digits:
            words.append((int(digits), ""))
            digits = ""
        words.append((-1, character))
    return words


def _told(file: LabelFile) -> str:
    return f"{len(file.labels)} points" if file.size is None else f"an image of {file.size[1]}x{file.size[0]}"


__all__ = ["LabelFile", "files_by_name", "matched_labels", "paired_files", "read_label_file"]
