"""GraspNet scene tree: what the data set class of the baseline, and those that follow it, walk through.

Source: graspnet/graspnet-baseline, ``dataset/graspnet_dataset.py``; graspnet/graspnetAPI, ``graspnetAPI/graspnet.py``
(camK.npy; object_id_list.txt, which GraspNet() opens of every scene of its split).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Annotated, Any, ClassVar, Literal

import annotated_types
import torch

from pcdata.errors import CaptureError, ConfigError, IntrinsicsError
from pcdata.exports.exported_images import Fields
from pcdata.exports.graspnet import GraspNetImages, meta_bytes, stored_frame
from pcdata.exports.registry import register_target
from pcdata.exports.sample_needs import colors_of
from pcdata.exports.target import Item, Note, Samples
from pcdata.files.npy import write_npy
from pcdata.geometry import rigid
from pcdata.io.images.writing import write_color
from pcdata.structures import DepthFrame, Episode, PointCloud

_API_FACTOR = 1000  # units per metre, fixed in graspnetAPI's loadScenePointCloud
_SPLITS = (range(100), range(100, 130), range(130, 160), range(160, 190))  # train, seen, similar, novel
_OBJECTS = "object_id_list.txt"


@register_target
@dataclass(frozen=True, kw_only=True)
class _GraspNetScenes(GraspNetImages):
    """``scenes/scene_XXXX/CAMERA/...``; give the folder to the loader as its ``root``.

    The captures, in order, are cut into scenes of ``frames_per_scene``. Their poses must lead to a frame whose z axis
    is up from the table, since the loader crops in it.

    Args:
        camera: the folder of the camera.
        first_scene: number of the first scene; the splits are train 0..99, seen 100..129, similar 130..159, novel
            160..189.
        frames_per_scene: 256 is what the loader asks for.
    """

    name: ClassVar[str] = "graspnet_scene"
    # dataset/graspnet_dataset.py of rhett-chen/graspness_implementation.
    also: ClassVar[Mapping[str, frozenset[str]]] = {"gsnet": frozenset()}
    layout: ClassVar[str] = (
        "scenes/scene_XXXX/CAMERA/: rgb, depth, label, meta, camK.npy, camera_poses.npy, cam0_wrt_table.npy"
    )

    camera: Literal["realsense", "kinect"] = "realsense"
    first_scene: Annotated[int, annotated_types.Interval(ge=0, le=9999)] = 0
    frames_per_scene: Annotated[int, annotated_types.Interval(ge=1, le=10000)] = 256

    @classmethod
    def example(cls, ids: Sequence[str]) -> dict[str, Any]:
        """One scene, where the samples do not fill whole ones."""
        return {"frames_per_scene": len(ids)} if len(ids) % cls.frames_per_scene else {}

    def plan(self, ids: Sequence[str], episodes: Sequence[Episode], left_out: Collection[str]) -> list[Item]:
        """Whole scenes alone: one with a frame that does not fit is left out, and those after it move up."""
        scenes = [item.ids for item in self.items(ids) if not any(sample_id in left_out for sample_id in item.ids)]
        return self.items([sample_id for scene in scenes for sample_id in scene])

    def items(self, ids: Sequence[str]) -> list[Item]:
        """One item per scene."""
        size = self.frames_per_scene
        if len(ids) % size:
            raise ConfigError(
                f"{self.name}: {len(ids)} captures do not fill scenes of {size}; the loader reads frames 0..255 of "
                "every scene. Give whole scenes, or say frames_per_scene=N for a loader changed to yours"
            )
        cuts = [ids[start : start + size] for start in range(0, len(ids), size)]
        return [Item(tuple(cut), (f"scenes/scene_{self.first_scene + n:04d}",)) for n, cut in enumerate(cuts)]

    def examine(self, item: Item, sample_id: str, data: DepthFrame | PointCloud, seen: dict[str, Any]) -> DepthFrame:
        """Return the view to write, of the camera and in the frame of those before it."""
        where = f"{self.name}: sample {sample_id!r}"
        frame = super().examine(item, sample_id, data, seen)
        if frame.world_from_camera is None:
            raise CaptureError(f"{where}: the loader needs camera poses, the capture has none; give poses/NAME.txt")
        if frame.labels is None:
            raise CaptureError(
                f"{where}: the loader reads labels even for testing, the capture has none; add labels/NAME.png"
            )
        matrix = seen.setdefault("intrinsics", frame.camera.intrinsics[0])
        if not torch.equal(frame.camera.intrinsics[0], matrix) or frame.frame_id != seen.setdefault(
            "frame", frame.frame_id
        ):
            raise IntrinsicsError(
                f"{where}: differs from the frames before in intrinsics or frame; it is another scene"
            )
        return frame

    def write(self, item: Item, samples: Samples, folder: Path, note: Note) -> None:
        """Write one scene."""
        scene = folder / item.paths[0] / self.camera
        for name in ("rgb", "depth", "label", "meta"):
            (scene / name).mkdir(parents=True)
        poses: list[torch.Tensor] = []
        seen: dict[str, Any] = {}
        objects: set[int] = set()
        for number, (sample_id, data) in enumerate(samples):
            stem = f"{number:04d}"
            frame = self.examine(item, sample_id, data, seen)
            assert frame.world_from_camera is not None
            write_color(scene / "rgb" / f"{stem}.png", torch.from_numpy(colors_of(self.name, frame)))
            factor = self.write_depth(scene / "depth" / f"{stem}.png", frame)
            if factor != _API_FACTOR:
                note(
                    f"depth is in units of 1/{factor:g} m, as meta says and the baseline's loader reads; graspnetAPI "
                    f"takes {_API_FACTOR} a metre whatever meta says: for its tools say factor_depth={_API_FACTOR} "
                    "round_depth=true"
                )
            self.write_labels(scene / "label" / f"{stem}.png", frame)
            (scene / "meta" / f"{stem}.mat").write_bytes(meta_bytes(frame, factor))
            poses.append(frame.world_from_camera[0])
            objects |= {number - 1 for number in frame.provenance.get("cls_indexes", ())}
            if "cls_indexes" not in frame.provenance or "camera_from_object" not in frame.provenance:
                note("captures without object poses have no cls_indexes and poses in meta: use load_label=False")
        table_from_camera = torch.stack(poses)
        first_from_table = rigid.invert_rigid(table_from_camera[:1])
        write_npy(scene / "camK.npy", seen["intrinsics"].numpy())
        write_npy(scene / "camera_poses.npy", (first_from_table @ table_from_camera).numpy())
        write_npy(scene / "cam0_wrt_table.npy", table_from_camera[0].numpy())
        (folder / item.paths[0] / _OBJECTS).write_text("".join(f"{number}\n" for number in sorted(objects)), "utf-8")

    @classmethod
    def cloud_fields(cls, folder: Path, names: Sequence[str]) -> Iterator[tuple[str, Fields]]:
        """Read the views of which the depth is among the files; the loader crops by itself, around the labels."""
        for name in names:
            if PurePath(name).match("scenes/*/*/depth/*.png"):
                depth = folder / name
                camera, stem = depth.parents[1], depth.stem
                color, meta = camera / f"rgb/{stem}.png", camera / f"meta/{stem}.mat"
                yield f"{depth.parents[2].name}/{camera.name}/{stem}", stored_frame(folder, depth, color, meta)

    def finish(self, items: Sequence[Item], folder: Path, note: Note) -> None:
        """Write empty lists of objects for the other scenes of the split: ``GraspNet()`` opens those of all."""
        exported = {self.first_scene + number for number in range(len(items))}
        others = {number for split in _SPLITS if exported & {*split} for number in split} - exported
        for number in sorted(others):
            scene = folder / f"scenes/scene_{number:04d}"
            scene.mkdir(parents=True)
            (scene / _OBJECTS).write_text("", "utf-8")
        if others:
            note(
                f"{len(others)} other scenes of the split are folders with an empty {_OBJECTS} alone, which GraspNet() "
                "opens of every scene; they have no images"
            )
