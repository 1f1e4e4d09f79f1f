"""Calibration boards: chessboard, ChArUco and a single tag, found in an image by OpenCV."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdata.errors import ConfigError, near_matches
from pcdata.extras import require

GrayImage = NDArray[np.uint8]  # (H, W)

_SYNTAX = "chessboard:COLSxROWS:SQUARE, charuco:COLSxROWS:SQUARE:MARKER:DICT[:legacy] or tag:DICT:SIDE[:ID]"
_LARGEST_SQUARE = 1.0  # metres; "25" was meant as millimetres
_MIN_CORNERS = 6  # a homography needs 4, and checks nothing with 4


@dataclass(frozen=True, eq=False)
class BoardView:
    """The corners of one board that were seen in one image."""

    board_points: NDArray[np.float64]  # (N, 3) metres on the board, z = 0
    pixels: NDArray[np.float64]  # (N, 2) u, v; integers are pixel centers


@dataclass(frozen=True)
class Chessboard:
    """A chessboard, all of which must be in the image. ``cols`` and ``rows`` count inner corners, as OpenCV does."""

    cols: int
    rows: int
    square: float  # side, metres

    def __post_init__(self) -> None:
        if self.cols < 3 or self.rows < 3 or not 0 < self.square <= _LARGEST_SQUARE:
            raise ConfigError(
                f"chessboard: needs at least 3x3 inner corners and squares of up to {_LARGEST_SQUARE:g} m (metres, not "
                f"millimetres), got {self.cols}x{self.rows} and {self.square:g}"
            )

    def find(self, image: GrayImage) -> BoardView | None:
        """Return all corners, or None where one is missing.

        The first of them has a bright square between itself and the corners next to it, where the board tells which end
        is which (:attr:`has_two_ends`); else either end may come first.

        Source: Duda & Frese, "Accurate Detection and Localization of Checkerboard Corners for Calibration", BMVC 2018.
        """
        cv2: Any = require("cv2")
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
        found, corners = cv2.findChessboardCornersSB(image, (self.cols, self.rows), flags=flags)
        if not found:
            return None
        row, column = np.divmod(np.arange(self.cols * self.rows), self.cols)
        points = np.stack([column, row, np.zeros_like(row)], axis=1) * self.square
        pixels = self._refined(cv2, image, corners)
        if self.has_two_ends and self._starts_dark(image, pixels):
            pixels = pixels[::-1].copy()
        return BoardView(points.astype(np.float64), pixels)

    @property
    def has_two_ends(self) -> bool:
        """Whether the board, turned by half a turn, looks different: one of its counts is odd, the other even."""
        return (self.cols + self.rows) % 2 == 1

    def _starts_dark(self, image: GrayImage, pixels: NDArray[np.float64]) -> bool:
        """Say whether the square after the first corner is of the dark ones, by the middles of all squares."""
        grid = pixels.reshape(self.rows, self.cols, 2)
        middles = np.rint((grid[:-1, :-1] + grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1]) / 4).astype(int)
        bright = image[middles[..., 1], middles[..., 0]].astype(np.float64)
        odd = np.add.outer(np.arange(self.rows - 1), np.arange(self.cols - 1)) % 2 == 1
        return bool(bright[~odd].mean() < bright[odd].mean())

    def _refined(self, cv2: Any, image: GrayImage, corners: NDArray[np.float32]) -> NDArray[np.float64]:
        """Move each corner to where the gradients around it point: halves the error in all but badly blurred images."""
        grid = corners.reshape(self.rows, self.cols, 2)
        spacing = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min()) for axis in (0, 1))
        # As wide as it can be without reaching the next corner, which at a slant is nearer than one square.
        half = int(np.clip(0.3 * spacing, 2, 11))
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
        refined = cv2.cornerSubPix(image, corners.reshape(-1, 1, 2).copy(), (half, half), (-1, -1), stop)
        return refined.reshape(-1, 2).astype(np.float64)

    def alternatives(self) -> list[tuple[Board, str]]:
        """Return the board whose squares were counted instead of its inner corners, and what to do when it is found."""
        if min(self.cols, self.rows) < 4:
            return []
        fewer = replace(self, cols=self.cols - 1, rows=self.rows - 1)
        return [(fewer, f"count inner corners, not squares: {fewer}")]

    def __str__(self) -> str:
        return f"chessboard:{self.cols}x{self.rows}:{self.square:g}"


@dataclass(frozen=True)
class Charuco:
    """A ChArUco board, any part of which may be in the image. ``cols`` and ``rows`` count squares, as OpenCV does."""

    cols: int
    rows: int
    square: float  # side, metres
    marker: float  # side, metres
    dictionary: str  # OpenCV's name without DICT_, e.g. "5X5_100"
    legacy: bool = False  # printed by OpenCV before 4.6 with an even number of rows

    def __post_init__(self) -> None:
        if self.cols < 3 or self.rows < 3 or not 0 < self.marker < self.square <= _LARGEST_SQUARE:
            raise ConfigError(
                f"charuco: needs at least 3x3 squares, and markers smaller than squares of up to {_LARGEST_SQUARE:g} m "
                f"(metres, not millimetres), got {self.cols}x{self.rows}, {self.square:g} and {self.marker:g}"
            )

    def find(self, image: GrayImage) -> BoardView | None:
        """Return the corners between recognized markers, or None where there are fewer than 6.

        Raises:
            ConfigError: OpenCV has no such dictionary.
        """
        cv2: Any = require("cv2")
        board = self.opencv_board()
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
        if ids is None or len(ids) < _MIN_CORNERS:
            return None
        points, pixels = board.matchImagePoints(corners, ids)
        return BoardView(points.reshape(-1, 3).astype(np.float64), pixels.reshape(-1, 2).astype(np.float64))

    def opencv_board(self) -> Any:
        """Return OpenCV's object for the board."""
        cv2: Any = require("cv2")
        dictionary = _dictionary("charuco", self.dictionary)
        board = cv2.aruco.CharucoBoard((self.cols, self.rows), self.square, self.marker, dictionary)
        board.setLegacyPattern(self.legacy)
        return board

    def alternatives(self) -> list[tuple[Board, str]]:
        """Return the board in OpenCV's other pattern, and what to do when it is found."""
        other = replace(self, legacy=not self.legacy)
        return [(other, f"it is printed in {'the legacy' if other.legacy else 'the present'} pattern: {other}")]

    def __str__(self) -> str:
        legacy = ":legacy" if self.legacy else ""
        return f"charuco:{self.cols}x{self.rows}:{self.square:g}:{self.marker:g}:{self.dictionary}{legacy}"


@dataclass(frozen=True)
class Tag:
    """One AprilTag or ArUco marker; its frame is in its middle. Four corners tell a pose, and nothing of a lens."""

    dictionary: str  # OpenCV's name without DICT_, e.g. "APRILTAG_36h11"
    side: float  # of the black square, metres
    number: int | None = None  # None = the only one in the image

    def __post_init__(self) -> None:
        if not 0 < self.side <= _LARGEST_SQUARE:
            raise ConfigError(
                f"tag: its side must be up to {_LARGEST_SQUARE:g} m (metres, not millimetres), got {self.side:g}"
            )

    def find(self, image: GrayImage) -> BoardView | None:
        """Return the tag's four corners, or None where it is not in the image.

        Raises:
            ConfigError: OpenCV has no such dictionary, or several tags are seen and which one is meant is not said.
        """
        cv2: Any = require("cv2")
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        detector = cv2.aruco.ArucoDetector(_dictionary("tag", self.dictionary), parameters)
        corners, ids, _ = detector.detectMarkers(image)
        seen = [] if ids is None else ids.ravel().tolist()
        if self.number is None and len(seen) > 1:
            raise ConfigError(f"tag: tags {', '.join(map(str, sorted(seen)))} are in one image; say which: {self}:ID")
        wanted = [at for at, number in enumerate(seen) if self.number in (None, number)]
        if len(wanted) != 1:
            return None
        half = self.side / 2
        points = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
        return BoardView(points, corners[wanted[0]].reshape(-1, 2).astype(np.float64))

    def alternatives(self) -> list[tuple[Board, str]]:
        """Return nothing: a tag is described in one way only."""
        return []

    def __str__(self) -> str:
        return f"tag:{self.dictionary}:{self.side:g}" + ("" if self.number is None else f":{self.number}")


# A flat pattern of known size; x runs along its columns, y along its rows, z into it.
Board = Chessboard | Charuco | Tag


def _dictionary(what: str, name: str) -> Any:
    """Return OpenCV's dictionary of markers of that name, whose letters may be small or large."""
    cv2: Any = require("cv2")
    known = {one.removeprefix("DICT_").upper(): one for one in sorted(dir(cv2.aruco)) if one.startswith("DICT_")}
    if name.upper() not in known:
        hint = near_matches(name.upper(), list(known)) or f"; known: {', '.join(known)}"
        raise ConfigError(f"{what}: OpenCV has no dictionary {name!r}{hint}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, known[name.upper()]))


def dictionary_of_number(number: int) -> str:
    """Return the name, without DICT_, of one of OpenCV's dictionaries, which other tools write as its number.

    Raises:
        ConfigError: OpenCV has no such dictionary.
    """
    cv2: Any = require("cv2")
    names = [name for name in dir(cv2.aruco) if name.startswith("DICT_") and getattr(cv2.aruco, name) == number]
    if not names:
        raise ConfigError(f"charuco: OpenCV has no dictionary of number {number}")
    return max(names).removeprefix("DICT_")  # of two spellings of one name the one with small letters


def parse_board(text: str) -> Board:
    """Read ``chessboard:9x6:0.025`` (inner corners), ``charuco:7x5:0.04:0.03:5X5_100`` (squares) or a tag.

    A tag is ``tag:APRILTAG_36h11:0.048``, with ``:ID`` where several are in an image. Lengths are metres.

    Raises:
        ConfigError: the text is no board.
    """
    kind, *parts = text.split(":")
    if kind == "tag" and len(parts) in (2, 3) and (len(parts) == 2 or re.fullmatch(r"[0-9]{1,4}", parts[2])):
        return Tag(parts[0].removeprefix("DICT_"), _length(text, parts[1]), int(parts[2]) if parts[2:] else None)
    legacy = kind == "charuco" and parts[-1:] == ["legacy"]
    parts = parts[:-1] if legacy else parts
    count = re.fullmatch(r"(\d{1,3})[xX](\d{1,3})", parts[0]) if parts else None
    if count is None or (kind, len(parts)) not in (("chessboard", 2), ("charuco", 4)):
        raise ConfigError(f"a board is {_SYNTAX}, lengths in metres; got {text!r}")
    cols, rows = int(count[1]), int(count[2])
    if kind == "chessboard":
        return Chessboard(cols, rows, _length(text, parts[1]))
    dictionary = parts[3].upper().removeprefix("DICT_")
    return Charuco(cols, rows, _length(text, parts[1]), _length(text, parts[2]), dictionary, legacy)


def _length(text: str, part: str) -> float:
    try:
        return float(part)
    except ValueError:
        raise ConfigError(f"a board is {_SYNTAX}; {part!r} in {text!r} is no length in metres") from None
