"""GraspNet baseline: one folder per frame, as its demo reads them.

Source: graspnet/graspnet-baseline, ``demo.py`` (get_and_process_data), ``doc/example_data``, ``utils/data_utils.py``.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from pcdata.errors import CaptureError, add_note
from pcdata.exports.exported_images import Fields, image_fields, stored_colors, stored_depth
from pcdata.exports.model_contracts import require_depth
from pcdata.exports.registry import register_target
from pcdata.exports.sample_needs import check_size, colors_of, object_ids, one_view
from pcdata.exports.target import Item, Note, Samples, Target
from pcdata.files.opening import check_inside
from pcdata.io.images.reading import read_mask
from pcdata.io.images.writing import depth_units, write_color, write_depth
from pcdata.io.sources.graspnet import read_meta
from pcdata.io.store.sample_keys import key_of
from pcdata.structures import DepthFrame, PointCloud

_WHY_SIZE = "graspnet-baseline asserts it"
_MILLIMETRE = 0.001
_MOST_OBJECTS = 255  # of an 8-bit label
_HEADER = b"MATLAB 5.0 MAT-file, written by pcdata".ljust(116)


@dataclass(frozen=True, kw_only=True)
class GraspNetImages(Target):
    """What both GraspNet layouts have in common.

    Args:
        view: which view, of captures with several.
        any_size: allow other images than 1280x720.
        factor_depth: stored units per metre; None = the capture's own unit if that is 1 mm or finer, else 1000.
        round_depth: round depth between two units, which loses up to half a unit.
        label_offset: added to the labels, so that objects count from 1.
    """

    takes: ClassVar[Literal["captures"]] = "captures"
    model: ClassVar[str] = "graspnet_baseline"
    left_to_loader: ClassVar[frozenset[str]] = frozenset({"count"})
    image_size: ClassVar[tuple[int, int] | None] = (720, 1280)

    view: int | None = None
    any_size: bool = False
    factor_depth: float | None = None
    round_depth: bool = False
    label_offset: int = 0

    def examine(self, item: Item, sample_id: str, data: DepthFrame | PointCloud, seen: dict[str, Any]) -> DepthFrame:
        """Return the view to write, of the size that the loader asserts, with color and depth that the units hold."""
        where = f"{self.name}: sample {sample_id!r}"
        frame = one_view(where, data, self.view)
        check_size(where, frame, self.image_size, _WHY_SIZE, self.any_size)
        require_depth(where, self, frame)
        colors_of(where, frame)
        if frame.labels is not None:
            object_ids(where, frame, self.label_offset, _MOST_OBJECTS)
        factor = self.units_per_metre(frame)
        try:
            depth_units(where, frame.depth[0], metres_per_unit=1 / factor, round_to_unit=self.round_depth)
        except CaptureError as error:
            add_note(error, f"with factor_depth={factor:g}; options: factor_depth=N, round_depth=true")
            raise
        return frame

    def write_depth(self, path: Path, frame: DepthFrame) -> float:
        """Write the depth as 16-bit PNG and return the units per metre."""
        factor = self.units_per_metre(frame)
        write_depth(path, frame.depth[0], metres_per_unit=1 / factor, round_to_unit=self.round_depth)
        return factor

    def units_per_metre(self, frame: DepthFrame) -> float:
        """Return the stored units per metre of a view."""
        own = frame.provenance.get("metres_per_unit")
        fine = isinstance(own, float) and own <= _MILLIMETRE
        return self.factor_depth or (1 / own if fine and own is not None else 1 / _MILLIMETRE)

    def write_labels(self, path: Path, frame: DepthFrame) -> None:
        """Write the labels as 8-bit PNG, 0 = background."""
        ids = object_ids(self.name, frame, self.label_offset, _MOST_OBJECTS).astype(np.uint8)
        Image.fromarray(ids).save(path, format="PNG")


@register_target
@dataclass(frozen=True, kw_only=True)
class _GraspNetFrames(GraspNetImages):
    """A folder per capture; give one of them to ``demo.py`` as ``data_dir``."""

    name: ClassVar[str] = "graspnet"
    layout: ClassVar[str] = "a folder per capture: color.png, depth.png, workspace_mask.png (1 bit), meta.mat"

    def items(self, ids: Sequence[str]) -> list[Item]:
        """One folder per sample."""
        return [Item((sample_id,), (key_of(sample_id),)) for sample_id in ids]

    def write(self, item: Item, samples: Samples, folder: Path, note: Note) -> None:
        """Write one folder."""
        for sample_id, data in samples:
            frame = self.examine(item, sample_id, data, {})
            colors = colors_of("", frame)
            target = folder / item.paths[0]
            target.mkdir()
            write_color(target / "color.png", torch.from_numpy(colors))
            factor = self.write_depth(target / "depth.png", frame)
            if frame.mask is None:
                note("captures without a mask get a workspace_mask.png that is all inside: the demo crops nothing")
            inside = np.ones(frame.size, dtype=bool) if frame.mask is None else frame.mask[0].numpy()
            # One bit per pixel: the loader's "mask & (depth > 0)" of an 8-bit image would index, not select.
            Image.fromarray(inside).save(target / "workspace_mask.png", format="PNG")
            if frame.labels is not None:
                self.write_labels(target / "label.png", frame)
            (target / "meta.mat").write_bytes(meta_bytes(frame, factor))

    @classmethod
    def cloud_fields(cls, folder: Path, names: Sequence[str]) -> Iterator[tuple[str, Fields]]:
        """Read the folders of which depth.png is among the files; what the mask leaves out, the demo leaves out."""
        for name in names:
            if name.endswith("/depth.png"):
                place = (folder / name).parent
                inside = place / "workspace_mask.png"
                check_inside("check", inside, [folder])
                yield (
                    name.removesuffix("/depth.png"),
                    stored_frame(
                        folder, place / "depth.png", place / "color.png", place / "meta.mat", read_mask(inside).numpy()
                    ),
                )


def stored_frame(folder: Path, depth: Path, color: Path, meta: Path, inside: NDArray[np.bool_] | None = None) -> Fields:
    """Read the files of one view of an export.

    Raises:
        CaptureError, UnitError: one is missing or damaged, or a link leads out of the export.
    """
    check_inside("check", meta, [folder])
    facts = read_meta(meta)
    pixels = stored_depth(folder, depth, 1 / facts["metres_per_unit"])
    return image_fields(depth, pixels, facts["intrinsic_matrix"], stored_colors(folder, color), inside)


def meta_bytes(frame: DepthFrame, factor_depth: float) -> bytes:
    """Return the MATLAB 5 file of one view; the same frame gives the same bytes."""
    from scipy.io import savemat

    values: dict[str, NDArray] = {
        "intrinsic_matrix": frame.camera.intrinsics[0].numpy(),
        "factor_depth": np.array([[factor_depth]]),
    }
    if "cls_indexes" in frame.provenance:
        values["cls_indexes"] = np.array([frame.provenance["cls_indexes"]], dtype=np.int64)
    if "camera_from_object" in frame.provenance:
        poses = np.array(frame.provenance["camera_from_object"], dtype=np.float32).reshape(-1, 4, 4)
        values["poses"] = np.ascontiguousarray(poses[:, :3].transpose(1, 2, 0))
    buffer = io.BytesIO()
    savemat(buffer, values, format="5")
    content = bytearray(buffer.getvalue())
    content[: len(_HEADER)] = _HEADER  # free text, in which SciPy puts the time of day
    return bytes(content)
