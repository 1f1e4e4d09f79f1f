"""DevicePipeline: the random rest of a pipeline on batches, where the model is."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import torch
from torch.utils.data import get_worker_info

from pcdata.datasets.samples import DRAWS, SampleDataset
from pcdata.datasets.streamed import StreamedCloudDataset
from pcdata.errors import ConfigError, DTypeError
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.structures.structure import with_tensors
from pcdata.transforms import Transform


class DevicePipeline:
    """Go through the batches of a loader, moved to a device and run through steps there.

    The workers read and pack; the steps run on whole batches, with the draws that the dataset would have made. On CUDA
    the next batch is copied from page-locked memory and runs on a stream of its own while the model works on this one;
    elsewhere the steps simply run. In a training loop::

        dataset = CachedCloudDataset(folder, augment=None)
        loader = DataLoader(dataset, batch_size=64, num_workers=4, collate_fn=collate_packed)
        for batch in DevicePipeline(loader, dataset.pipeline.split()[1], device="cuda", collate=collate_padded):

    Args:
        loader: a ``DataLoader`` of a dataset of pcdata whose own transform draws nothing, with ``collate_packed``.
        transform: the steps; from clouds to clouds.
        device: where they run.
        collate: what is made of the clouds in the end, such as ``collate_padded``; None = packed clouds.

    Raises:
        ConfigError: in a worker; the dataset's transform is random; or the loader's workers have begun.
        DTypeError: the loader is none of a dataset of pcdata, or gives no packed clouds.
    """

    def __init__(
        self,
        loader: Iterable[PointCloud],
        transform: Transform,
        *,
        device: torch.device | str,
        collate: Callable[[list[PointCloud]], Any] | None = None,
    ) -> None:
        _refuse_workers()
        dataset = getattr(loader, "dataset", None)
        if isinstance(dataset, StreamedCloudDataset):
            dataset = dataset.dataset
        if not isinstance(dataset, SampleDataset):
            raise DTypeError(
                f"DevicePipeline: loader must be a DataLoader of a dataset of pcdata, got {type(loader).__name__} of "
                f"{type(dataset).__name__}"
            )
        if not (isinstance(transform, Transform) and transform.gives is PointCloud):
            raise DTypeError(f"DevicePipeline: transform must be a pcdata Transform to clouds, got {transform!r:.100}")
        if dataset.transform is not None and dataset.transform.is_random:
            raise ConfigError(
                "DevicePipeline: the dataset draws at random already, and the steps here would draw the same again; "
                "open it with augment=None, and give all random steps to the DevicePipeline"
            )
        if getattr(loader, "_iterator", None) is not None:
            raise ConfigError("DevicePipeline: the loader's workers have begun; make the DevicePipeline before")
        dataset.notes_draws = True
        self.loader = loader
        self.transform = transform
        self.device = torch.device(device)
        self.collate = collate

    def __len__(self) -> int:
        return len(self.loader)  # type: ignore[arg-type]

    def __iter__(self) -> Iterator[Any]:
        _refuse_workers()
        if self.device.type != "cuda":
            return map(self._made, self.loader)
        return _one_ahead(self.loader, self._made, _SideStream(self.device))

    def _made(self, batch: Any) -> Any:
        if not isinstance(batch, PointCloud):
            raise DTypeError(
                f"DevicePipeline: the loader must give packed clouds, got {type(batch).__name__}; give it "
                "collate_fn=collate_packed, and the DevicePipeline the other collate"
            )
        streams = Streams([entry[DRAWS] for entry in batch.meta])
        if self.device.type == "cuda" and not batch.points.is_cuda and not batch.points.is_pinned():
            batch = batch.pin_memory()
        clouds = self.transform(batch.to(self.device, non_blocking=True), generator=streams)
        return clouds if self.collate is None else self.collate([clouds])


class _SideStream:
    """A CUDA stream that works beside the one of the model."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream = torch.cuda.Stream(device)

    def begin(self, make: Callable[[Any], Any], batch: Any) -> tuple[Any, Any]:
        """Put the work on a batch on the stream; return what it becomes, and the event of its end."""
        with torch.cuda.stream(self._stream):
            made = make(batch)
            return made, self._stream.record_event()

    def hand_over(self, made: Any, event: Any) -> Any:
        """Let the model's stream wait for a batch, and its memory for the model."""
        stream = torch.cuda.current_stream(self._device)
        stream.wait_event(event)
        with_tensors(made, lambda tensor: tensor.record_stream(stream) or tensor)
        return made


def _one_ahead(batches: Iterable[Any], make: Callable[[Any], Any], side: _SideStream) -> Iterator[Any]:
    """Give batches, each after the work on the next has begun."""
    begun: tuple[Any, Any] | None = None
    for batch in batches:
        following = side.begin(make, batch)
        if begun is not None:
            yield side.hand_over(*begun)
        begun = following
    if begun is not None:
        yield side.hand_over(*begun)


def _refuse_workers() -> None:
    if get_worker_info() is not None:
        raise ConfigError(
            "DevicePipeline: runs where the model is, not in a worker of a DataLoader, which must not use the device; "
            "give the worker's dataset the steps, or go through the loader with a DevicePipeline in the main process"
        )
