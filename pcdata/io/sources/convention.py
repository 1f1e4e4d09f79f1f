"""Captures whose poses, depth or rows are not as a camera here has them: ``{"axes": "opengl", "depth": "ray"}``.

Simulators and renderers each have a convention of their own. It is stated once, around whatever reads the files.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

from pcdata.errors import CaptureError, ConfigError, DTypeError, near_matches
from pcdata.files.sample_names import check_known
from pcdata.functional.depth.rendered import (
    BUFFERS,
    DEPTH_VALUES,
    DepthValues,
    check_planes,
    ray_lengths,
    z_of_rendered,
)
from pcdata.geometry.camera_axes import CAMERA_AXES
from pcdata.geometry.rigid import invert_rigid
from pcdata.io.sources.capture_source import CaptureSource, checked_ids
from pcdata.io.sources.combine import DerivedSource
from pcdata.io.sources.option_checks import check_numbers
from pcdata.io.sources.registry import register_combinator
from pcdata.io.sources.rendered_images import ROWS, centered_camera, upright_image
from pcdata.structures import DepthFrame

POSES = ("world_from_camera", "camera_from_world")
PRINCIPAL_POINTS = ("center", "corner")


@register_combinator
@dataclass(frozen=True, kw_only=True)
class ConventionSource(DerivedSource):
    """Captures of another convention, as cameras here have them.

    Args:
        source: the captures, read as if they were of this convention.
        axes: of the cameras that the poses are of, one of CAMERA_AXES.
        poses: what the poses are, "world_from_camera" or "camera_from_world".
        depth: what the depth is, one of DEPTH_VALUES. A buffer's shares are read as metres first: floats as they are,
            whole numbers by ``metres_per_unit`` = 1 / the highest.
        near: metres, where depth is a buffer's share: the plane that 0 stands for; 0 = not stated.
        far: metres, where depth is a buffer's share: the plane that 1 stands for, where there is no reading.
        rows: which row of an image is stored first, "top_first" or "bottom_first".
        principal_point: where pixel 0 of the intrinsics is: "center" of the first pixel, or its "corner", as width / 2
            of simulators is.
    """

    kind: ClassVar[str] = "convention"

    source: CaptureSource
    axes: str = "opencv"
    poses: str = "world_from_camera"
    depth: DepthValues = "z"
    near: float = 0.0
    far: float = 0.0
    rows: str = "top_first"
    principal_point: str = "center"

    def __post_init__(self) -> None:
        where = "ConventionSource"
        for option, known in (
            ("axes", CAMERA_AXES),
            ("poses", POSES),
            ("depth", DEPTH_VALUES),
            ("rows", ROWS),
            ("principal_point", PRINCIPAL_POINTS),
        ):
            value = getattr(self, option)
            if not isinstance(value, str) or value not in known:
                raise ConfigError(
                    f"{where}: {option} must be one of {', '.join(known)}{near_matches(str(value), known)}, got "
                    f"{value!r:.100}"
                )
        check_numbers(where, self, whole=(), real=("near", "far"))
        if self.depth in BUFFERS:
            check_planes(where, self.near, self.far, error=ConfigError)
        elif self.near or self.far:
            raise ConfigError(f"{where}: near and far are of depth = {' or '.join(BUFFERS)}; leave them out")
        checked_ids(where, self.source)

    def made_of(self, sample_id: str) -> list[tuple[CaptureSource, str]]:
        """Return the capture that is converted.

        Raises:
            CaptureError: no sample has this id.
        """
        check_known("ConventionSource", sample_id, frozenset(self.source.ids))
        return [(self.source, sample_id)]

    def load(self, sample_id: str) -> DepthFrame:
        """Load a capture and convert it.

        Raises:
            CaptureError: no sample has this id, or a buffer holds no shares.
            DTypeError: it is no depth frame.
        """
        ((source, own),) = self.made_of(sample_id)
        frame = source.load(own)
        if not isinstance(frame, DepthFrame):
            raise DTypeError("ConventionSource: converts depth frames, but the source holds point clouds")
        return self.converted(frame)

    def converted(self, frame: DepthFrame) -> DepthFrame:
        """Return one frame of this convention as cameras here have it.

        Raises:
            CaptureError: it has no poses although something is said of them, or a buffer holds no shares.
        """
        camera = frame.camera
        if self.principal_point == "corner":
            camera = centered_camera(camera)
        images = {role: getattr(frame, role) for role in _IMAGES}
        upright = {role: upright_image(image, self.rows) for role, image in images.items() if image is not None}
        depth = upright["depth"]
        if self.depth == "ray":
            depth = (depth / ray_lengths(frame.size, camera.intrinsics, camera.distortion)).nan_to_num(0.0).float()
        elif self.depth != "z":
            depth = z_of_rendered(f"capture {frame.sample_id!r}", depth, self.depth, self.near, self.far)
        pose = frame.world_from_camera
        if pose is not None:
            pose = invert_rigid(pose) if self.poses == "camera_from_world" else pose
            pose = pose @ CAMERA_AXES[self.axes]
        elif (self.axes, self.poses) != ("opencv", "world_from_camera"):
            raise CaptureError(f"capture {frame.sample_id!r} has no pose; leave out axes and poses of the convention")
        facts: dict[str, Any] = {
            name: getattr(self, name) for name in _SAID if self.depth in BUFFERS or name not in ("near", "far")
        }
        read = dict(frame.provenance)
        if self.depth in BUFFERS:  # what was read were shares of the way from near to far, not lengths
            read = {name: value for name, value in read.items() if name not in _OF_LENGTHS}
        return replace(
            frame,
            depth=depth,
            camera=camera,
            world_from_camera=pose,
            provenance={**read, "convention": facts},
            colors=upright.get("colors"),
            labels=upright.get("labels"),
            confidence=upright.get("confidence"),
            mask=upright.get("mask"),
        )


_SAID = ("axes", "poses", "depth", "near", "far", "rows", "principal_point")
_IMAGES = ("depth", "colors", "labels", "confidence", "mask")
_OF_LENGTHS = ("metres_per_unit", "depth_encoding", "unit_is_recorded")
