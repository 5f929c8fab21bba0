"""Flat boards to calibrate with, chessboard and ChArUco, and where an image shows their corners.

A board's own plane has x along its columns and y along its rows, in squares, from its top left.
OpenCV finds the corners: Duda and Frese 2018 for chessboards, ArUco's markers for the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, cast

import cv2
import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.image.sharpness import LONGEST_SIDE_PX, resized

DICTIONARIES: dict[str, int] = {
    name.removeprefix("DICT_").lower(): getattr(cv2.aruco, name)
    for name in dir(cv2.aruco)
    if name.startswith("DICT_")
}
"""ArUco's dictionaries of markers by the names of OpenCV, in small letters."""
_LARGEST = ("4x4_1000", "5x5_1000", "6x6_1000", "7x7_1000", "apriltag_36h11", "aruco_original")
_MIN_CORNERS = 8
"""Fewer say less of the camera than of where the board is."""
_SEEN_MARKERS = 4
"""So many at once are no accident."""


@dataclass(frozen=True, kw_only=True)
class Board:
    """columns, rows: squares, not inner corners.

    marker_share: side of a marker over that of a square.     dictionary: of ``DICTIONARIES``.
    """

    kind: Literal["chessboard", "charuco"]
    columns: int
    rows: int
    marker_share: float = 0.75
    dictionary: str = "4x4_50"

    @cached_property
    def corners(self) -> F64:
        """(N, 2) inner corners, row by row."""
        x, y = np.meshgrid(np.arange(1.0, self.columns), np.arange(1.0, self.rows))
        return np.stack([x.ravel(), y.ravel()], axis=1)

    @cached_property
    def outline(self) -> F64:
        """(4, 2) outer corners, all the way round."""
        return np.array(
            [(0, 0), (self.columns, 0), (self.columns, self.rows), (0, self.rows)], float
        )

    def aruco(self, *, legacy: bool = False) -> Any:
        """OpenCV's board.  legacy: with a marker at the top left, as before version 4.6."""
        dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary])
        size = (self.columns, self.rows)
        board: Any = cv2.aruco.CharucoBoard(size, 1.0, self.marker_share, dictionary)
        board.setLegacyPattern(legacy)
        return board


@dataclass(frozen=True)
class BoardView:
    """What one image shows of a board: (N, 2) corners on the board, and their (N, 2) pixels."""

    corners: F64
    points_px: F64


class BoardFinder:
    """Finds one board in images."""

    def __init__(self, board: Board) -> None:
        self.board = board
        self._detectors: list[Any] = []
        if board.kind == "charuco":
            # Which of the two ways its markers lie shows at the first image.
            boards = [board.aruco(legacy=legacy) for legacy in (False, True)]
            self._detectors = [cv2.aruco.CharucoDetector(each) for each in boards]

    def find(self, grey: U8) -> BoardView | None:
        """The board in an image (H, W); None where it is not, or too little of it."""
        return self._charuco(grey) if self._detectors else self._chessboard(grey)

    def _chessboard(self, grey: U8) -> BoardView | None:
        small = resized(grey, LONGEST_SIDE_PX)
        size = (self.board.columns - 1, self.board.rows - 1)
        found, corners = cv2.findChessboardCornersSB(
            small, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE
        )
        if not found:
            return None
        scale = np.array(grey.shape[::-1]) / np.array(small.shape[::-1])
        points = (np.asarray(corners, np.float64).reshape(-1, 2) + 0.5) * scale - 0.5
        return BoardView(self.board.corners, self._refined(grey, points))

    def _refined(self, grey: U8, points_px: F64) -> F64:
        """Where two edges cross, in a window that holds no other corner (Foerstner 1987).

        Four times as exact as what CALIB_CB_ACCURACY finds of rendered boards, and at no cost.
        """
        rows = points_px.reshape(self.board.rows - 1, self.board.columns - 1, 2)
        steps = [np.linalg.norm(np.diff(rows, axis=axis), axis=2).min() for axis in (0, 1)]
        half = max(2, int(min(steps) / 3.0))
        end = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)
        start = np.ascontiguousarray(points_px, np.float32).reshape(-1, 1, 2)
        refined = cv2.cornerSubPix(grey, start, (half, half), (-1, -1), end)
        return np.asarray(refined, np.float64).reshape(-1, 2)

    def _charuco(self, grey: U8) -> BoardView | None:
        for detector in self._detectors:
            points, ids, _, _ = detector.detectBoard(grey)
            if ids is not None and len(ids) >= _MIN_CORNERS:
                self._detectors = [detector]
                corners = self.board.corners[np.asarray(ids).ravel()]
                return BoardView(corners, np.asarray(points, np.float64).reshape(-1, 2))
        return None


def boards_seen(images: Sequence[U8]) -> list[str]:
    """In words, which boards the images (H, W) show: for a user who named another."""
    for name in _LARGEST:
        detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARIES[name]))
        found: list[Any] = [detector.detectMarkers(grey)[1] for grey in images]
        most = max((0 if ids is None else len(ids) for ids in found), default=0)
        if most >= _SEEN_MARKERS:  # between them there are small chessboards, too
            return [f"{most} markers of {name.removesuffix('_1000')}"]
    sizes: list[tuple[int, int]] = []
    for grey in images:
        small = resized(grey, LONGEST_SIDE_PX)
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
        seen, _, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), flags)
        if seen:
            rows, columns = cast(Any, meta).shape[:2]
            sizes.append((max(rows, columns) + 1, min(rows, columns) + 1))
    often = max(sizes, key=lambda size: (sizes.count(size), size), default=(0, 0))
    if sizes.count(often) < 2:  # what sticks out of an image is seen in part
        return []
    return [f"a chessboard of {often[0]}x{often[1]} squares"]
