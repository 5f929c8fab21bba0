"""A camera from views of a flat board: which views, the lens, and how sure it is.

The least squares are OpenCV's (Zhang 2000).  What they say of themselves is too sure, as the errors
of one view go together: the uncertainty is that of leaving views out in turn (the jackknife).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np

from pliant.algorithms.arrays import F64, I64, BoolArray
from pliant.algorithms.boards import Board, BoardView
from pliant.algorithms.rectification import Lens, rectified_camera

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
    """Indices of views that differ from each other, of those that do not the sharpest.

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
    """The lens that fits the views best; None where there are too few that agree, or none fits."""
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
    """The fit, and whether its k3 is more than noise.  None where it does not converge."""
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
        rectified_camera(lens)  # raises ValueError where it folds within the image
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
    """Of the logarithm of the mean focal length; inf where leaving views out leaves no lens."""
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
