"""Exports held to a model's contract once more: what is on disk, as ``pcdata check`` judges anybody's files."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pcdata.errors import CacheError, CaptureError, ConfigError, ContractError, PcdataError
from pcdata.exports.export_record import FILE_NAME, ExportRecord
from pcdata.exports.target import CloudArray, Target
from pcdata.exports.targets import TARGETS
from pcdata.io.arrays.stored_arrays import stored_arrays
from pcdata.models import ModelBatch, check, contract, preset
from pcdata.models.batching import batch_of
from pcdata.models.catalog import possible_choices
from pcdata.models.model_check import reports_of_file
from pcdata.structures import Camera, DepthFrame, PointCloud
from pcdata.structures.kinds import FIELDS
from pcdata.transforms import Compose, FillHoles, InpaintDepth
from pcdata.validation import SampleReport, Summary
from pcdata.verdicts import Finding, Verdict


def is_export(path: str | os.PathLike[str]) -> bool:
    """Say whether a path is a folder that an export wrote, or a file or folder in one, by its record."""
    return (Path(path) / FILE_NAME).is_file() or _export_around(Path(path)) is not None


def check_export(
    folder: str | os.PathLike[str],
    model: str,
    /,
    *,
    frame_id: str = "",
    unit: str = "",
    limit: int | None = None,
    **choices: Any,
) -> Summary:
    """Judge every sample of an export; its record says which arrays or files are what, and the frame and the unit.

    Of an export of images, what its loader makes of them is judged. What a loader makes true by itself is not judged
    for the models that it feeds.

    Args:
        folder: what :func:`pcdata.export_dataset` wrote, or a file or folder in it: only the samples there are judged.
        model: the contract's name; that of the target, or another that takes the same points or images.
        frame_id: the frame of the data, where the samples were in several.
        unit: "m" or "normalized", where the samples were in several.
        limit: only so many samples.
        choices: what the contract leaves open, besides the options of the export; the frame is that of the export.

    Raises:
        CacheError: the export is damaged or unfinished.
        ConfigError: an unknown model or choice, or a target whose files, or the given ones, hold nothing for a model.
        ContractError: there is no sample to judge.
    """
    asked = Path(folder)
    folder = asked if (asked / FILE_NAME).is_file() else _export_around(asked) or asked
    record = ExportRecord.read(folder)
    contract(model, **choices)
    if record.target not in TARGETS:
        raise CacheError(f"{folder / FILE_NAME}: no target {record.target!r:.100}; export again")
    if not record.complete:
        raise CacheError(f"{folder} holds an unfinished export; finish it with 'pcdata export --continue'")
    target = TARGETS[record.target]
    if len(record.coordinates) == 1:  # what is recorded is so; an argument can only say what is not known
        ((frame_id, unit),) = record.coordinates
    stated = {"frame": frame_id.split("/")[0], "num_points": record.options.get("num_points")}
    known = possible_choices(contract(model))
    choices = {**{name: value for name, value in stated.items() if name in known and value}, **choices}
    if target.any_crop and model in target.models():
        choices = {"crop": None, **choices}
    asks = _Asked(target, model, choices, frame_id, unit)
    if files := target.cloud_arrays(folder, record.options):
        reports = _of_arrays(asks, folder, asked, files)
    else:
        reports = _of_fields(asks, folder, asked, record.files)
    summary = Summary(islice(reports, limit))
    if not sum(summary.samples.values()):
        raise ContractError(f"check: there is nothing to judge: {folder} holds 0 samples")
    return summary


@dataclass(frozen=True)
class _Asked:
    """What the samples are judged by, and what is known of them."""

    target: type[Target]
    model: str
    choices: Mapping[str, Any]
    frame_id: str
    unit: str

    @property
    def is_own(self) -> bool:
        """Whether the model is fed by the target's loader."""
        return self.model in self.target.models()

    def report(self, name: str, findings: Iterable[Finding]) -> SampleReport:
        """Return the findings but for those that the loader makes true."""
        left = self.target.left_for(self.model)
        return SampleReport(name, tuple(one for one in findings if one.name not in left))


def _of_arrays(asks: _Asked, folder: Path, asked: Path, files: Mapping[Path, CloudArray]) -> Iterator[SampleReport]:
    """Judge the clouds of arrays that hold all of their channels."""
    if folder != asked:
        places = {path: path / array.name for path, array in files.items()}
        files = {path: files[path] for path, place in places.items() if _lies_in(place, asked)}
        if not files:
            shown = ", ".join(str(place.relative_to(folder)) for place in islice(places.values(), 3))
            raise ConfigError(f"check: {asked} holds no clouds: those of the export {folder} are in {shown}")
    (channels,) = {array.channels for array in files.values()}
    choices = asks.choices
    if asks.is_own and "channels" in possible_choices(contract(asks.model)):
        choices = {"channels": list(channels), **choices}
    for path, array in files.items():
        keys = {"points": array.name}
        numbers = _categories(path, array.category) if array.category and "category" not in choices else None
        for report in reports_of_file(path, asks.model, keys, asks.frame_id, asks.unit, choices, channels, numbers):
            name = f"{path.name}/{report.sample_id}" if len(files) > 1 else report.sample_id
            yield asks.report(name, report.findings)


def _categories(path: Path, name: str) -> list[int]:
    with stored_arrays(path, {name}) as stored:
        return [int(number) for number in np.ravel(stored[name][...])]


def _of_fields(asks: _Asked, folder: Path, asked: Path, names: Sequence[str]) -> Iterator[SampleReport]:
    """Judge clouds whose channels lie in columns or files of their own, and images."""
    none, target = True, asks.target
    try:
        for name, fields in target.cloud_fields(folder, [one for one in names if _lies_in(folder / one, asked)]):
            none = False
            yield asks.report(name, _findings(asks, fields))
    except (OSError, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        raise CacheError(f"check: {folder}: cannot be read: {error}; export again") from error
    if none and next(target.cloud_fields(folder, names), None) is not None:
        raise ConfigError(f"check: {asked} holds no samples of the export {folder}; give that, or a part with samples")
    if none:
        raise ConfigError(
            f"check: {folder}: the target {target.name} writes {target.layout}, which check does not read; "
            f"every sample passed the rules of {target.model} when it was exported"
        )


def _findings(asks: _Asked, fields: Mapping[str, NDArray[Any]]) -> Iterator[Finding]:
    """Judge one sample by what is there of it."""
    made, choices = contract(asks.model, **asks.choices), asks.choices
    try:
        if made.takes == "depth image":
            batch = _batch_of_image(asks, fields)
        else:
            given = {"rgb": "colors" in fields, "normals": "normals" in fields}
            channels = [channel for spec in contract(asks.model).tensors for channel in spec.channels]
            if asks.is_own and any(channel.optional and not given[channel.name] for channel in channels):
                kept = [one.name for one in channels if not one.optional or given[one.name]]
                choices = {"channels": kept, **choices}
            batch = _batch_of_points(asks, fields, choices)
    except PcdataError as error:
        yield Finding(name="channels", verdict=Verdict.FAIL, found=str(error), advice="export again, or another model")
        return
    summary = check(batch, asks.model, **choices)
    yield from (entry.worst for entry in summary.checks.values() if entry.worst)


def _batch_of_points(asks: _Asked, fields: Mapping[str, NDArray[Any]], choices: Mapping[str, Any]) -> ModelBatch:
    if "points" not in fields:
        raise CaptureError(f"{asks.model}: takes points, and images without intrinsics give none")
    if not len(fields["points"]):
        raise CaptureError(f"{asks.model}: takes points, and the sample has none")
    # As they are: a cloud made of arrays would refuse what is to be found in them, and make normals unit vectors.
    held = {name: torch.from_numpy(np.array(fields[name], np.float32)) for name in fields if name in FIELDS}
    if "colors" in held:
        held["colors"] = held["colors"] / 255
    cloud = PointCloud(**held, frame_id=asks.frame_id or "unknown")  # type: ignore[arg-type]
    batch = batch_of([cloud], contract(asks.model, **choices), choices)
    # As from a file: not held to the centering in the frame's name.
    return replace(batch, steps=None, frame_id=asks.frame_id, unit=asks.unit or batch.unit)


def _batch_of_image(asks: _Asked, fields: Mapping[str, NDArray[Any]]) -> ModelBatch:
    """Cut the window as the preset does; nothing is filled in, as the loaders of files fill in nothing."""
    if "depth" not in fields:
        raise CaptureError(f"{asks.model}: takes depth images, and the sample has points alone")
    depth, colors = torch.from_numpy(np.array(fields["depth"], np.float32)), fields.get("image")
    finite = torch.isfinite(depth)
    height, width = depth.shape
    focal = float(max(height, width))  # not known, and of no account: a window is a window
    frame = DepthFrame(
        depth=torch.where(finite, depth, 1.0)[None],
        camera=Camera.pinhole(fx=focal, fy=focal, cx=width / 2, cy=height / 2, size=(height, width)),
        colors=None if colors is None else torch.from_numpy(np.array(colors))[None],
    )
    choices = dict(asks.choices)
    if "window" in possible_choices(contract(asks.model)):
        choices.setdefault("window", min(height, width, *(contract(asks.model).window or ())))
    made = preset(asks.model, **choices)
    cut = Compose([step for step in made.pipeline.steps if not isinstance(step, (InpaintDepth, FillHoles))])
    batch = batch_of([cut(frame) if len(cut) else frame], made.contract, made.choices)
    if bool(finite.all()):
        return batch
    # The loaders subtract a mean, which one NaN makes NaN.
    return replace(batch, tensors={key: torch.full_like(tensor, torch.nan) for key, tensor in batch.items()})


def _export_around(path: Path) -> Path | None:
    """Return the export that wrote this file, or files below this folder; None = none did."""
    for folder in Path(os.path.abspath(path)).parents:
        if (folder / FILE_NAME).is_file():
            files = (folder / name for name in ExportRecord.read(folder).files)
            return folder if any(_lies_in(file, path) for file in files) else None
    return None


def _lies_in(file: Path, path: Path) -> bool:
    return Path(os.path.abspath(file)).is_relative_to(os.path.abspath(path))
