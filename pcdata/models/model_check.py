"""check: is a batch, or a data set, what a model takes."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pcdata.datasets import CachedCloudDataset, SampleDataset
from pcdata.errors import ContractError, DTypeError, PcdataError, locates_path
from pcdata.models.batch import ModelBatch
from pcdata.models.batching import batch_of
from pcdata.models.catalog import contract as contract_named
from pcdata.models.contract import ModelContract
from pcdata.models.declared_rules import cheap_checks
from pcdata.models.foreign import read_samples
from pcdata.models.value_rules import value_checks
from pcdata.structures import DepthFrame, PointCloud
from pcdata.validation import SampleReport, Summary
from pcdata.verdicts import Finding, Verdict


def check(
    data: Any,
    model: str,
    /,
    *,
    frame_id: str = "",
    unit: str = "",
    channel_names: Mapping[str, tuple[str, ...]] | None = None,
    cheap: bool = False,
    limit: int | None = None,
    **choices: Any,
) -> Summary:
    """Judge data by a model's contract: one verdict per rule, with what to do.

    Args:
        data: a ``ModelBatch``, a ``PointCloud``, ``DepthFrame``, a mapping of tensors or arrays by the names of the
            model's code, or a data set or list of any of these.
        model: the contract's name.
        frame_id: the frame of the data, where they do not say it themselves.
        unit: "m" or "normalized", where the data do not say it themselves.
        channel_names: the names of the channels of each tensor, where the data do not say it themselves.
        cheap: read declarations and shapes alone, no values: for every step of a training loop.
        limit: only so many samples of a data set.
        choices: what the contract leaves open, as for :func:`preset`; a preset's batch, and a data set that was built
            for the model, bring their own.

    Raises:
        ConfigError: an unknown model or choice.
        ContractError: there is no sample to judge.
        DTypeError: something that is no data.
    """
    if isinstance(data, CachedCloudDataset) and data.manifest.model.get("name") == model:
        choices = {**data.manifest.model["choices"], **choices}
    contract_named(model, **choices)
    summary = Summary()
    for number, (name, sample) in enumerate(_samples(data)):
        if limit is not None and number >= limit:
            break
        declared = {"frame_id": frame_id, "unit": unit, "channels": channel_names}
        summary.add(SampleReport(name, tuple(_checks(sample, model, choices, declared, cheap))))
    _require_samples(summary, "the data")
    return summary


@locates_path
def check_files(
    path: str | Path,
    model: str,
    keys: Mapping[str, str],
    /,
    *,
    frame_id: str = "",
    unit: str = "",
    limit: int | None = None,
    **choices: Any,
) -> Summary:
    """Judge every sample of an npz, npy, HDF5 or zarr v2 file that anybody wrote.

    Args:
        path: the file, or the zarr directory.
        model: the contract's name.
        keys: from a tensor of the model, or points, colors, normals, to the array's name in the file.
        frame_id: the frame of the data, unless unknown.
        unit: "m" or "normalized", unless unknown.
        limit: only so many samples.
        choices: what the contract leaves open.

    Raises:
        CacheError, CaptureError: the file cannot be read, has no such array, or claims sizes that cannot be true.
        ConfigError: an unknown model, choice or key.
        ContractError: there is no sample to judge.
        DTypeError: an array that holds no numbers.
        ShapeError: arrays without samples, or that do not go together.
    """
    summary = Summary()
    for report in itertools.islice(reports_of_file(path, model, keys, frame_id, unit, choices), limit):
        summary.add(report)
    _require_samples(summary, str(path))
    return summary


def reports_of_file(
    path: str | Path,
    model: str,
    keys: Mapping[str, str],
    frame_id: str,
    unit: str,
    choices: Mapping[str, Any],
    columns: tuple[str, ...] = (),
    categories: Sequence[int] | None = None,
) -> Iterator[SampleReport]:
    """Judge one sample after another; see :func:`check_files`.

    ``columns`` are the names of the channels of the first tensor, and ``categories`` the class of every sample, where
    somebody knows them.
    """
    contract = contract_named(model, **choices)
    made = _category_tensors(contract, choices)
    for number, (name, stored, channels) in enumerate(read_samples(path, contract, keys)):
        if categories is not None:
            made = _category_tensors(contract, {"category": categories[number]})
        channels = {**channels, contract.main.key: columns} if columns else channels
        channels = {**{spec.key: spec.channel_names for spec in contract.tensors if spec.key in made}, **channels}
        declared = {"frame_id": frame_id, "unit": unit, "channels": channels}
        yield SampleReport(name, tuple(_checks({**made, **stored}, model, choices, declared, False)))


def require(data: Any, model: str, /, *, but: Collection[str] = (), **options: Any) -> None:
    """Refuse data that :func:`check` fails; warnings pass.

    Args:
        data: as for :func:`check`.
        model: the contract's name.
        but: names of rules that do not count, since somebody makes them true later.
        options: as for :func:`check`.

    Raises:
        ContractError: every rule that failed, with what to do.
    """
    summary = check(data, model, **options)
    failed = [entry.worst for (rule, _), entry in summary.checks.items() if rule not in but and entry.worst is not None]
    faults = [f"{one.name}: {one.found}; {one.advice}" for one in failed if one.verdict is Verdict.FAIL]
    if faults:
        raise ContractError(f"{model}: the model does not take this:\n" + "\n".join(faults))


def _checks(
    sample: Any, model: str, choices: Mapping[str, Any], declared: Mapping[str, Any], cheap: bool
) -> Iterable[Finding]:
    if isinstance(sample, ModelBatch) and sample.model == model:
        choices = {**sample.choices, **choices}
    contract = contract_named(model, **choices)
    try:
        batch = _as_batch(sample, contract, choices, declared)
    except PcdataError as error:
        # The model's tensors cannot even be made of it.
        return [Finding(name="channels", verdict=Verdict.FAIL, found=str(error), advice="use the preset's pipeline")]
    checks = list(cheap_checks(batch, contract))
    return checks if cheap else [*checks, *value_checks(batch, contract)]


def _category_tensors(contract: ModelContract, choices: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the one-hot tensors that a chosen category makes: files hold its number, or nothing."""
    if "category" not in choices:
        return {}
    return {
        spec.key: np.eye(spec.width, dtype=spec.dtype)[choices["category"]].reshape([1] * (len(spec.axes) - 1) + [-1])
        for spec in contract.tensors
        if spec.content == "category"
    }


def _require_samples(summary: Summary, what: str) -> None:
    if not sum(summary.samples.values()):
        raise ContractError(
            f"check: there is nothing to judge: {what} hold 0 samples; give at least one, and a limit of at least 1"
        )


def _as_batch(
    sample: Any, contract: ModelContract, choices: Mapping[str, Any], declared: Mapping[str, Any]
) -> ModelBatch:
    if isinstance(sample, ModelBatch):
        return sample
    if isinstance(sample, (PointCloud, DepthFrame)):
        return batch_of([sample], contract, choices)
    if not isinstance(sample, Mapping):
        raise DTypeError(
            f"a sample must be a batch, a cloud, a depth image or named tensors, got {type(sample).__name__}"
        )
    tensors = {key: _as_tensor(key, value) for key, value in sample.items() if isinstance(value, (Tensor, np.ndarray))}
    return ModelBatch(
        tensors=tensors, frame_id=declared["frame_id"], unit=declared["unit"], channels=declared["channels"] or {}
    )


def _as_tensor(key: str, value: Tensor | np.ndarray) -> Tensor:
    if isinstance(value, Tensor):
        return value
    if value.dtype.kind not in "biuf":
        raise DTypeError(f"{key}: must hold numbers, got {value.dtype}")
    native = value.dtype.newbyteorder("=") if value.dtype.itemsize <= 8 else np.dtype(np.float64)  # all that torch has
    with np.errstate(over="ignore"):
        return torch.from_numpy(np.ascontiguousarray(value, native))


def _samples(data: Any) -> Iterable[tuple[str, Any]]:
    if isinstance(data, (ModelBatch, PointCloud, DepthFrame, Mapping)):
        return [("batch", data)]
    if isinstance(data, SampleDataset):
        return zip(data.ids, data)
    if hasattr(data, "__iter__") and not isinstance(data, (str, bytes, Tensor, np.ndarray)):
        return ((str(number), sample) for number, sample in enumerate(data))
    raise DTypeError(
        f"check: takes a batch, clouds, named tensors or a data set, got {type(data).__name__}; name a bare tensor as "
        "the model does: {'points': tensor}"
    )
