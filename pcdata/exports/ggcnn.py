"""GG-CNN: depth as TIFF, color and grasp rectangles, numbered and named as in the Cornell data set.

Source: dougsm/ggcnn, ``utils/data/cornell_data.py``, ``utils/dataset_processing/grasp.py`` (load_from_cornell_file),
``utils/dataset_processing/image.py``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from pcdata.errors import CaptureError, ConfigError
from pcdata.exports.exported_images import Fields, stored_colors, stored_depth
from pcdata.exports.model_contracts import require_image
from pcdata.exports.registry import register_target
from pcdata.exports.sample_needs import check_size, colors_of, one_view
from pcdata.exports.target import Item, Note, Samples, Target
from pcdata.files.opening import read_text
from pcdata.io.images.writing import write_color
from pcdata.io.store.sample_keys import key_of
from pcdata.structures import DepthFrame, PointCloud
from pcdata.transforms import CompleteDepth, InpaintDepth

_WHY_SIZE = "the loader crops as if it were"
_FIRST, _LAST = 100, 9999  # pcd0100 is the first of the original, four digits are the pattern
_CORNERS = 4


@register_target
@dataclass(frozen=True, kw_only=True)
class _GGCNN(Target):
    """``01/pcd0100d.tiff``, ``01/pcd0100r.png``, ``01/pcd0100cpos.txt``; the folder is the loader's ``--dataset-path``.

    Args:
        grasps: the folder of ``<sample>.txt`` files with the corners of good grasps, four lines "x y" each, in pixels
            (as Cornell's cpos files), or a mapping from sample id to (G, 4, 2) corners; None = to be added later.
        holes: pixels without a reading: "inpainted" fills them in as the authors' code does (see InpaintDepth, which
            needs OpenCV), "smooth" and "nearest" in other ways (see CompleteDepth), "nan" and "zero" mark them. The
            loader subtracts the mean of the image: a NaN makes all of it NaN, zeros shift it.
        colors: write ``r.png``; False = depth alone (``--use-rgb 0``).
        view: which view, of captures with several.
        any_size: allow other images than 640x480.
    """

    name: ClassVar[str] = "ggcnn"
    takes: ClassVar[Literal["captures"]] = "captures"
    model: ClassVar[str] = "ggcnn"
    # utils/data/cornell_data.py of skumra/robotic-grasping.
    also: ClassVar[Mapping[str, frozenset[str]]] = {"grconvnet": frozenset()}
    image_size: ClassVar[tuple[int, int] | None] = (480, 640)  # that the loaders crop from
    layout: ClassVar[str] = "Cornell names: pcdNNNNd.tiff (float32 metres), pcdNNNNr.png, pcdNNNNcpos.txt"

    grasps: Path | Mapping[str, Any] | None = None
    holes: Literal["inpainted", "smooth", "nearest", "nan", "zero"] = "inpainted"
    colors: bool = True
    view: int | None = None
    any_size: bool = False

    def items(self, ids: Sequence[str]) -> list[Item]:
        """Three files per sample; the depth is put into place last."""
        if len(ids) > _LAST - _FIRST + 1:
            raise ConfigError(
                f"ggcnn: numbers end at {_LAST}, so {_LAST - _FIRST + 1} captures at most, got {len(ids)}"
            )
        items = []
        for number, sample_id in enumerate(ids, _FIRST):
            stem = f"{number // 100:02d}/pcd{number:04d}"
            items.append(Item((sample_id,), (f"{stem}r.png", f"{stem}cpos.txt", f"{stem}d.tiff")))
        return items

    def examine(
        self, item: Item, sample_id: str, data: DepthFrame | PointCloud, seen: dict[str, Any]
    ) -> tuple[DepthFrame, NDArray[np.float32], NDArray[np.float64] | None]:
        """Return the view, its depth without holes (or as said), and the corners of grasps."""
        where = f"ggcnn: sample {sample_id!r}"
        frame = one_view(where, data, self.view)
        check_size(where, frame, self.image_size, _WHY_SIZE, self.any_size)
        require_image(where, self, frame)
        if self.colors:
            colors_of(where, frame, "; or say colors=false for depth alone")
        grasps = None if self.grasps is None else self._grasps(where, sample_id)
        return frame, self._depth(where, frame), grasps

    def write(self, item: Item, samples: Samples, folder: Path, note: Note) -> None:
        """Write up to three files."""
        color_path, grasp_path, depth_path = (folder / path for path in item.paths)
        for sample_id, data in samples:
            frame, depth, corners = self.examine(item, sample_id, data, {})
            depth_path.parent.mkdir(exist_ok=True)
            if self.colors:
                write_color(color_path, torch.from_numpy(colors_of("ggcnn", frame)))
            if corners is None:
                note("no grasps were given: the loader finds images by their pcdNNNNcpos.txt, so add those files first")
            else:
                text = "".join(f"{x:.9g} {y:.9g}\n" for x, y in corners.reshape(-1, 2))
                grasp_path.write_text(text, encoding="utf-8")
            if self.holes in ("nan", "zero") and bool((frame.depth[0] == 0).any()):
                effect = "NaN in all of its input" if self.holes == "nan" else "a depth of 0 m as if it were measured"
                note(
                    f"some images keep holes (holes={self.holes}): the training loader gets {effect}; it fills nothing "
                    "in"
                )
            Image.fromarray(depth).save(depth_path, format="TIFF")

    @classmethod
    def cloud_fields(cls, folder: Path, names: Sequence[str]) -> Iterator[tuple[str, Fields]]:
        """Read the depth of every image, and its color where it was written."""
        for name in names:
            if name.endswith("d.tiff"):
                color = folder / f"{name.removesuffix('d.tiff')}r.png"
                fields: Fields = {"depth": stored_depth(folder, folder / name)}
                yield name, {**fields, "image": stored_colors(folder, color)} if color.is_file() else fields

    def _depth(self, where: str, frame: DepthFrame) -> NDArray[np.float32]:  # (H, W) metres
        if self.holes in ("inpainted", "smooth", "nearest"):
            step = InpaintDepth() if self.holes == "inpainted" else CompleteDepth(completion=self.holes)
            whole = step(replace(frame, mask=None))
            depth: NDArray[np.float32] = whole.depth[0].numpy()
            if (depth == 0).any():
                raise CaptureError(f"{where}: holes cannot be filled in where nothing is known; leave the capture out")
            return depth
        depth = frame.depth[0].numpy().copy()
        if self.holes == "nan":
            depth[depth == 0] = np.nan
        return depth

    def _grasps(self, where: str, sample_id: str) -> NDArray[np.float64]:  # (G, 4, 2) x, y
        if isinstance(self.grasps, Mapping):
            if sample_id not in self.grasps:
                raise ConfigError(f"{where}: grasps has no entry for it; every capture needs one")
            corners = np.asarray(self.grasps[sample_id])
        else:
            assert self.grasps is not None
            path = self.grasps / f"{key_of(sample_id)}.txt"
            try:
                corners = np.array(
                    [[float(word) for word in line.split()] for line in read_text(where, path).splitlines()]
                )
            except ValueError as error:
                if isinstance(error, CaptureError):
                    raise
                raise ConfigError(f"{where}: {path}: must have two numbers 'x y' a line: {error}") from error
            if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) % _CORNERS:
                raise ConfigError(f"{where}: {path}: must have four lines 'x y' per grasp, got {corners.shape}")
            corners = corners.reshape(-1, _CORNERS, 2)
        if corners.dtype.kind not in "fiu" or corners.shape[1:] != (_CORNERS, 2) or not np.isfinite(corners).all():
            raise ConfigError(
                f"{where}: grasps must be finite (G, 4, 2) corners x, y, got {corners.dtype} {corners.shape}"
            )
        if not len(corners):
            raise ConfigError(f"{where}: has no grasp, and the loader cannot crop without one; leave the capture out")
        return corners.astype(np.float64)
