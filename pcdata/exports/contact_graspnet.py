"""Contact-GraspNet: one ``.npz`` per view.

Source: NVlabs/contact_graspnet, ``contact_graspnet/data.py`` (load_available_input_data), ``inference.py``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from pcdata.exports.exported_images import Fields, image_fields
from pcdata.exports.model_contracts import require_depth
from pcdata.exports.registry import register_target
from pcdata.exports.sample_needs import object_ids, one_view
from pcdata.exports.target import Item, Note, Samples, Target
from pcdata.files.npz import write_npz
from pcdata.files.opening import check_inside
from pcdata.io.arrays.stored_arrays import stored_arrays
from pcdata.io.store.sample_keys import key_of
from pcdata.models import contract
from pcdata.structures import DepthFrame, PointCloud


@register_target
@dataclass(frozen=True, kw_only=True)
class _ContactGraspNet(Target):
    """A folder of ``<sample>.npz``; give it to the loader as ``--np_path=DIR/*.npz``.

    Never a cloud: of a file with ``xyz`` alone the loader leaves the intrinsics unset and stops.

    Args:
        view: which view, of captures with several.
        label_offset: added to the labels, so that objects count from 1.
    """

    name: ClassVar[str] = "contact_graspnet"
    takes: ClassVar[Literal["captures"]] = "captures"
    model: ClassVar[str] = "contact_graspnet_api"
    # The network itself: inference.py turns, centers and samples.
    also: ClassVar[Mapping[str, frozenset[str]]] = {"contact_graspnet": frozenset({"frame", "normalization"})}
    left_to_loader: ClassVar[frozenset[str]] = frozenset({"crop", "count"})
    layout: ClassVar[str] = "one npz per capture: depth (metres), K, and segmap and rgb where the capture has them"

    view: int | None = None
    label_offset: int = 0

    def items(self, ids: Sequence[str]) -> list[Item]:
        """One file per sample."""
        return [Item((sample_id,), (f"{key_of(sample_id)}.npz",)) for sample_id in ids]

    def examine(
        self, item: Item, sample_id: str, data: DepthFrame | PointCloud, seen: dict[str, Any]
    ) -> dict[str, NDArray[Any]]:
        """Return the arrays by name."""
        where = f"contact_graspnet: sample {sample_id!r}"
        frame = one_view(where, data, self.view)
        require_depth(where, self, frame)
        arrays: dict[str, NDArray[Any]] = {"depth": frame.depth[0].numpy(), "K": frame.camera.intrinsics[0].numpy()}
        if frame.labels is not None:
            arrays["segmap"] = object_ids(where, frame, self.label_offset, 2**31 - 1).astype(np.int32)
        if frame.colors is not None:
            # The loader swaps the channels before it shows the image.
            arrays["rgb"] = np.ascontiguousarray(frame.colors[0].numpy()[..., ::-1])
        return arrays

    def write(self, item: Item, samples: Samples, folder: Path, note: Note) -> None:
        """Write one file."""
        near, far = _z_range()
        for sample_id, data in samples:
            arrays = self.examine(item, sample_id, data, {})
            depth = arrays["depth"]
            if "segmap" not in arrays:
                note(
                    "captures without labels have no segmap: run inference.py without --local_regions, --filter_grasps"
                )
            if not ((depth > near) & (depth < far)).any():
                note(f"some captures have no depth within {near}..{far} m, which inference.py crops to; use --z_range")
            with open(folder / item.paths[0], "xb") as file:
                write_npz(file, arrays)

    @classmethod
    def cloud_fields(cls, folder: Path, names: Sequence[str]) -> Iterator[tuple[str, Fields]]:
        """Read depth and K of every file."""
        for name in names:
            check_inside("check", folder / name, [folder])
            with stored_arrays(folder / name, {"depth", "K"}) as stored:
                yield name, image_fields(folder / name, stored["depth"][...], stored["K"][...])


def _z_range() -> tuple[float, float]:
    """The default ``--z_range`` of inference.py, in metres."""
    crop = contract(_ContactGraspNet.model).crop
    assert crop is not None
    return crop[0][2], crop[1][2]
