"""A camera from views of a flat board: which views, the lens, and how sure it is.

Boards are chessboards and ChArUco.  A board's own plane has x along its columns and y along its
rows, in squares, from its top left.  OpenCV finds the corners: Duda and Frese 2018 for chessboards,
ArUco's markers for the others.

The least squares are OpenCV's (Zhang 2000).  Their own standard deviations are too small, as errors
of one view correlate: the uncertainty is that of leaving views out in turn (the jackknife).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, TypeAlias, cast

import cv2
import numpy as np

from pliant.algorithms.arrays import F64, I64, U8, BoolArray
from pliant.algorithms.image.sharpness import LONGEST_SIDE_PX, resized
from pliant.algorithms.rectification import Lens, rectified_camera

DICTIONARIES: dict[str, int] = {
    name.removeprefix("DICT_").lower(): getattr(cv2.aruco, name)
    for name in dir(cv2.aruco)
    if name.startswith("DICT_")
}
"""ArUco's dictionaries of markers by the names of OpenCV, in small letters."""
_LARGEST = ("4x4_1000", "5x5_1000", "6x6_1000", "7x7_1000", "apriltag_36h11", "aruco_original")
_MIN_CORNERS = 8
"""Fewer corners determine the pose of the board, but hardly the camera."""
_SEEN_MARKERS = 4
"""This many at once are not found by chance."""

BoardLens: TypeAlias = Literal["pinhole-radtan", "fisheye"]

MIN_VIEWS = 6
"""Three are enough where nothing is wrong with any."""
_MAX_VIEWS = 40
"""More add time and hardly any knowledge."""
_LEAST_CHANGE = 0.05
"""Share of the image's width that an outer corner of the board moves to make it another view."""
_OUTLYING = 3.0
"""Times the median error of a view: it was blurred, or a corner is another's."""
_FOLDS = 10
_FLAGS_HOME: Any = cv2 if hasattr(cv2, "CALIB_RECOMPUTE_EXTRINSIC") else cv2.fisheye  # OpenCV 5, 4
_FISHEYE_FLAGS = _FLAGS_HOME.CALIB_RECOMPUTE_EXTRINSIC | _FLAGS_HOME.CALIB_FIX_SKEW
_SIGNIFICANT = 3.0


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
        """Return OpenCV's board.  legacy: with a marker at the top left, as before version 4.6."""
        dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary])
        size = (self.columns, self.rows)
        board: Any = cv2.aruco.CharucoBoard(size, 1.0, self.marker_share, dictionary)
        board.setLegacyPattern(legacy)
        return board


@dataclass(frozen=True)
class BoardView:
    """The board in one image: (N, 2) corners on the board, and their (N, 2) pixels."""

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
        """The board in an image (H, W); None if it is not, or too little of it."""
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
    """Describe the boards that the images (H, W) show, for a user who named another."""
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


@dataclass(frozen=True, kw_only=True)
class BoardCalibration:
    """focal_sigma: standard deviation of the logarithm of the focal length.

    used: (V,) views that agree.    residuals: per view that is used, (N, 2) px, seen - predicted.
    """

    lens: Lens
    focal_sigma: float
    used: BoolArray
    residuals: tuple[F64, ...]

    @property
    def rms_px(self) -> float:
        """Root mean square distance between a corner and where the lens puts it."""
        squares = np.concatenate([np.square(each).sum(axis=1) for each in self.residuals])
        return float(np.sqrt(squares.mean()))


def choose_views(
    views: Sequence[BoardView], sharpness: Sequence[float], board: Board, width: int
) -> I64:
    """Indices of views that differ from each other; of similar ones, the sharpest.

    What a view is like is where it has the board's outer corners: that is place, size and tilt.
    width: of the images, px.
    """
    outlines = np.array([_outline(view, board) for view in views]) / width
    order = np.argsort(-np.asarray(sharpness), kind="stable")
    step = _LEAST_CHANGE
    while True:
        kept: list[int] = []
        for i in order.tolist():
            if all(_change(outlines[i], outlines[j]) >= step for j in kept):
                kept.append(i)
        if len(kept) <= _MAX_VIEWS:
            return np.sort(np.array(kept, np.int64))
        step *= 2.0**0.25


def _outline(view: BoardView, board: Board) -> F64:
    """(4, 2) px.  Clipped: what is far outside is a matter of a few corners' noise."""
    H: Any = cv2.findHomography(view.corners, view.points_px)[0]
    low, high = view.points_px.min(axis=0), view.points_px.max(axis=0)
    if H is None:
        return np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    outline = cv2.perspectiveTransform(board.outline[None], H)[0]
    return np.clip(outline, low - (high - low), high + (high - low))


def _change(one: F64, other: F64) -> float:
    """Half a turn in its plane makes no other view, and not always another one of a chessboard."""
    turned = np.roll(other, 2, axis=0)
    return float(min(np.abs(one - other).max(), np.abs(one - turned).max()))


def calibrate(
    views: Sequence[BoardView], width: int, height: int, model: BoardLens
) -> BoardCalibration | None:
    """The lens that fits the views best; None if there are too few that agree, or none fits."""
    used: BoolArray = np.ones(len(views), bool)
    while True:
        if used.sum() < MIN_VIEWS:
            return None
        chosen = [view for view, use in zip(views, used, strict=True) if use]
        fitted = _fitted(chosen, width, height, model)
        if fitted is None:
            return None
        errors = np.array([np.sqrt(np.square(r).sum(axis=1).mean()) for r in fitted.residuals])
        bad = errors > _OUTLYING * np.median(errors)
        if not bad.any():
            break
        used[np.flatnonzero(used)[bad]] = False
    return BoardCalibration(
        lens=fitted.lens,
        focal_sigma=_jackknifed(chosen, fitted),
        used=used,
        residuals=fitted.residuals,
    )


@dataclass(frozen=True)
class _Fit:
    lens: Lens
    residuals: tuple[F64, ...]
    flags: int


def _fitted(views: Sequence[BoardView], width: int, height: int, model: BoardLens) -> _Fit | None:
    """Terms that the views do not tell are left out: beyond the views they would run away."""
    if model == "fisheye":
        return _solved(views, width, height, model, 0, None)[0]
    simple, _ = _solved(views, width, height, model, cv2.CALIB_FIX_K3, None)
    full, significant = _solved(views, width, height, model, 0, None)
    return full if full is not None and (significant or simple is None) else simple


def _solved(
    views: Sequence[BoardView],
    width: int,
    height: int,
    model: BoardLens,
    flags: int,
    start: Lens | None,
) -> tuple[_Fit | None, bool]:
    """The fit, and whether its k3 is significant.  None if it does not converge."""
    on_board = [np.pad(view.corners, ((0, 0), (0, 1))) for view in views]
    seen = [view.points_px for view in views]
    try:
        matrix, k, turns, places, sigma = _minimised(
            on_board, seen, (width, height), model, flags, start
        )
        lens = Lens(
            model=model,
            width=width,
            height=height,
            fx=float(matrix[0, 0]),
            fy=float(matrix[1, 1]),
            cx=float(matrix[0, 2]),
            cy=float(matrix[1, 2]),
            coefficients=tuple(np.ravel(k).tolist()),
        )
        rectified_camera(lens)  # raises ValueError if it folds within the image
    except (cv2.error, ValueError):
        return None, False
    residuals: list[F64] = []
    for corners, pixels, turn, place in zip(on_board, seen, turns, places, strict=True):
        points = corners @ cv2.Rodrigues(turn)[0].T + np.ravel(place)
        residuals.append(pixels - lens.project(points[:, :2] / points[:, 2:]))
    if not all(np.isfinite(each).all() for each in residuals):
        return None, False
    significant = model == "fisheye" or abs(lens.coefficients[4]) > _SIGNIFICANT * sigma
    return _Fit(lens, tuple(residuals), flags), bool(significant)


def _minimised(
    on_board: list[F64],
    seen: list[F64],
    size: tuple[int, int],
    model: BoardLens,
    flags: int,
    start: Lens | None,
) -> tuple[F64, F64, Any, Any, float]:
    """K, coefficients, the boards' poses, and the standard deviation of k3.  Raises cv2.error."""
    matrix = np.eye(3) if start is None else start.pinhole.K
    k = np.zeros(4 if model == "fisheye" else 5) if start is None else np.array(start.coefficients)
    module: Any = cv2.fisheye if model == "fisheye" else cv2
    flags |= 0 if start is None else cv2.CALIB_USE_INTRINSIC_GUESS  # the same for both
    if model == "fisheye":
        flags |= _FISHEYE_FLAGS
        points = [each[None] for each in on_board], [each[None] for each in seen]
        _, matrix, k, *poses = module.calibrate(*points, size, matrix, k[:, None], flags=flags)
        return matrix, k, *poses, 0.0
    single = [each.astype(np.float32) for each in on_board], [s.astype(np.float32) for s in seen]
    _, matrix, k, turns, places, sigmas, *_ = module.calibrateCameraExtended(
        *single, size, matrix, k, flags=flags
    )
    return matrix, np.ravel(k)[:5], turns, places, float(np.ravel(sigmas)[8])


def _jackknifed(views: Sequence[BoardView], fit: _Fit) -> float:
    """Jackknife sigma of the log mean focal length; inf if a fit without some views fails."""
    folds = min(_FOLDS, len(views))
    logs: list[float] = []
    lens = fit.lens
    model: BoardLens = "fisheye" if lens.model == "fisheye" else "pinhole-radtan"
    for fold in range(folds):
        left = [view for i, view in enumerate(views) if i % folds != fold]
        again, _ = _solved(left, lens.width, lens.height, model, fit.flags, lens)
        if again is None:
            return np.inf
        logs.append(0.5 * np.log(again.lens.fx * again.lens.fy))
    return float(np.sqrt((folds - 1.0) * np.var(logs)))
