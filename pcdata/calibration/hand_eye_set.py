"""Folders with all that calibrates a camera to a robot: poses, images, the camera's intrinsics and the board."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from pcdata.calibration.board_images import read_gray
from pcdata.calibration.board_pose import locate_board
from pcdata.calibration.boards import Board, Chessboard, GrayImage
from pcdata.errors import CalibrationError, CaptureError, ConfigError
from pcdata.files.sample_names import in_order
from pcdata.structures import Camera

Size = tuple[int, int]  # (height, width)
_MOST_LISTED = 100


class HandEyeSet(NamedTuple):
    """What a folder says; metres, pixels. Images are named whether they are there or not."""

    tool: str  # that saved it
    base_from_gripper: Mapping[str, Tensor]  # by the pose's name, each (4, 4) float64
    camera_from_target: Mapping[str, Tensor]  # of the poses whose target was located by the tool
    images: Mapping[str, Path]
    camera_for: Callable[[Size], Camera] | None  # the camera of images of a size; None = no file describes one
    camera_said: str  # the file, and what it says in words; or what is missing
    board: Board | None
    board_said: str  # the file that describes it; or why there is none

    @property
    def missing(self) -> list[str]:
        """The images that are named, or follow from the names of the poses, and are not there."""
        wanted = [path for name, path in self.images.items() if name not in self.camera_from_target]
        return [f"{path.parent.name}/{path.name}" for path in wanted if not path.is_file()]

    def targets(self, where: str, board: Board | None, camera: Camera | None) -> dict[str, tuple[Tensor, float | None]]:
        """Locate the target for every pose: ``camera_from_target`` and its RMS in pixels, None where it was saved.

        Images in which the board is not seen are left out.

        Args:
            where: the folder, for errors.
            board: in place of the set's own.
            camera: in place of the set's own.

        Raises:
            CaptureError: images are missing, of which names are told, or of another size than the camera.
            CalibrationError: the board is in none of them.
            ConfigError: the set does not describe its board, or its camera.
        """
        board = board or self.board
        found: dict[str, tuple[Tensor, float | None]] = {
            name: (pose, None) for name, pose in self.camera_from_target.items()
        }
        if all(name in found for name in self.base_from_gripper):
            return found
        if missing := self.missing:
            raise CaptureError(
                f"{where}: {len(self.base_from_gripper)} poses of the robot and the camera ({self.camera_said}) are "
                f"read; {len(missing)} images that show the target are missing: {_listed(missing)}. "
                f"{self._with_images(board)}"
            )
        if board is None:
            raise ConfigError(f"{where}: {self.board_said}")
        images = {name: read_gray(path) for name, path in self.images.items() if name not in found}
        for name, image in images.items():
            if camera is None and self.camera_for is None:
                raise ConfigError(f"{where}: {self.camera_said}; give --calibration FILE with the camera")
            of_image = camera or self.camera_for((image.shape[0], image.shape[1]))  # type: ignore[misc]
            if (located := locate_in_image(str(self.images[name]), image, board, of_image)) is not None:
                found[name] = located
        if not found:
            raise CalibrationError(f"{where}: {board} is in none of the {len(images)} images{_other(board, images)}")
        return found

    def _with_images(self, board: Board | None) -> str:
        if board is None:
            return f"With the images: {self.board_said}"
        said = f" ({self.board_said})" if board is self.board else ""
        return f"Put them there: with {board}{said} the same command locates the target in them"


def locate_in_image(
    where: str, image: GrayImage, board: Board, camera: Camera
) -> tuple[Tensor, float] | None:  # camera_from_target (4, 4), RMS in pixels
    """Return where the board stands in an image; None = it is not seen.

    Raises:
        ConfigError: the board looks the same turned by half a turn.
        CaptureError: the image is of another size than the camera's.
    """
    if isinstance(board, Chessboard) and not board.has_two_ends:
        raise ConfigError(
            f"calib hand-eye: {board} looks the same turned by half a turn, so its pose is not certain; use a board "
            "with an odd and an even number of inner corners, or a ChArUco board"
        )
    if image.shape != camera.size:
        raise CaptureError(
            f"{where}: is {image.shape[1]}x{image.shape[0]}, the camera {camera.size[1]}x{camera.size[0]}"
        )
    view = board.find(image)
    return None if view is None else locate_board(view, camera)


def _listed(names: list[str]) -> str:
    """Return all names, as far as anybody reads on: they are what is to be fetched."""
    more = len(names) - _MOST_LISTED
    return ", ".join(in_order(names)[:_MOST_LISTED]) + (f" and {more} more" if more > 0 else "")


def _other(board: Board, images: Mapping[str, Any]) -> str:
    for other, advice in board.alternatives():
        if any(other.find(image) is not None for image in images.values()):
            return f"; {advice}"
    return "; is it the board that was described, in focus and evenly lit?"
