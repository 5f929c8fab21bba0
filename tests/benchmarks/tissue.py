"""Surfels on a video without ground truth, beside Lucas-Kanade: who lives, and who is right.

The reference is the first frame's own patch: 31 x 31 pixels about the place of birth, found in a
later frame by an affine ECC (Evangelidis and Psarakis 2008).  It cannot drift, but it can slide
along an edge, and it exists only where the surface still looks as it did.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from benchmarks.table import markdown
from pliant.algorithms.arrays import F64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker
from pliant.datasets import open_source
from pliant.datasets.rectifier import Rectifier
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError
from pliant.evaluation.surfel_truth import roc

_LK: dict[str, Any] = {"winSize": (21, 21), "maxLevel": 4}
_RETURN_PX = 1.0
_HALF, _MARGIN = 15, 12
"""Half a side of the reference's patch, and how far about a place it is searched, px."""
_STEP_S = 1.0 / 15.0
_EVERY = 3
"""Frames from one search to the next: each begins with the affine of the last one."""
_MIN_CORRELATION = 0.9
_RIGHT_PX = 3.0
_NEIGHBOURS = 8
_COVERED_PX = 24.0
_HEADER = (
    "frame",
    "covered %",
    "alive %",
    "right %",
    "wrong %",
    "confirmed %",
    "right %",
    "wrong %",
    "AUC",
    "LK alive %",
    "right %",
    "wrong %",
    "reference",
)


def measure(source: str, frames: str, without: str, overrides: Sequence[str]) -> Iterator[str]:
    """A row for each frame of a list such as "50,100".

    without: polygon "u,v,u,v,..." in the first frame, px: surfels that are born in it do not count,
    such as those on an instrument.  overrides: KEY=VALUE of ``SurfelParameters``.  right: alive and
    within 3 px of the reference, of all surfels that have one.  wrong: farther from it, of the
    alive ones that have one.  The same of the confirmed ones alone.  AUC: of the confidence, for
    the alive ones.  covered: share of the image within 24 px of a tracked surfel.
    Raises DatasetError.
    """
    numbers = [int(each) for each in frames.split(",")]
    corners = np.array([float(each) for each in without.split(",") if each]).reshape(-1, 2)
    settings = {"depth_from": "flat"} | dict(each.split("=", 1) for each in overrides)
    parameters = SurfelParameters.model_validate(settings)
    yield from _rows(source, numbers, corners, parameters)


def _rows(
    source: str, frames: Sequence[int], left_out: F64, parameters: SurfelParameters
) -> Iterator[str]:
    images, camera = load(source, max(frames) + 1)
    tracker = SurfelTracker(parameters)
    flat = np.ones((camera.height, camera.width))
    followed = [tracker.start(images[0], flat, camera)]
    followed += [tracker.track(image, _STEP_S) for image in images[1:]]
    counted = outside(followed[0].points_px.astype(np.float64), left_out)
    points = followed[0].points_px[counted].astype(np.float64)
    flow, kept = lucas_kanade(images, points)
    reference = first_frame_reference(images, points, flow, kept, frames)
    rows: list[list[str]] = []
    for frame in frames:
        truth = reference[frame]
        known = np.isfinite(truth[:, 0])
        where, alive, confirmed, confidence = rows_of(followed[frame], followed[0].ids[counted])
        judged = alive & known
        area = roc(confidence[judged], _near(where, truth)[judged])[2]
        seen = covered(followed[frame], images[0].shape)
        ours = [seen, *judge(where, alive, truth), *judge(where, confirmed, truth)]
        theirs = judge(flow[frame], kept[frame], truth)
        cells = [*_shares(ours), f"{area:.2f}", *_shares(theirs), f"{known.mean():.0%}"]
        rows.append([str(frame), *cells])
    yield f"{source}: {len(points)} surfels, depth flat"
    yield markdown(_HEADER, rows)


def _shares(values: Sequence[float]) -> list[str]:
    return [f"{100.0 * value:.1f}" for value in values]


def load(source: str, count: int) -> tuple[list[U8], PinholeCamera]:
    """The first ``count`` grey images, rectified.  Raises DatasetError where there are fewer."""
    dataset = open_source(SourceSpec(location=source))
    rectifier = Rectifier(dataset.calibration)
    images: list[U8] = []
    for frame in dataset:
        if len(images) < count:
            images.append(rectifier.rectify(frame)[0])
    if len(images) < count:
        raise DatasetError(f"{source}: {len(images)} frames; --frames asks for {count}")
    return images, rectifier.camera


def outside(points: F64, polygon: F64) -> BoolArray:
    """(N,) which of (N, 2) points lie outside of a (K, 2) polygon; all where it has no corners."""
    if len(polygon) < 3:
        return np.ones(len(points), np.bool_)
    corners = polygon.astype(np.float32)
    return np.array([cv2.pointPolygonTest(corners, (u, v), False) < 0 for u, v in points], np.bool_)


def covered(surfels: SurfelFrame, shape: tuple[int, ...]) -> float:
    """Share of the image within 24 px of a tracked surfel."""
    free = np.full(shape, 255, np.uint8)
    tracked = surfels.points_px[surfels.state == SurfelState.TRACKED]
    column, row = np.rint(tracked).astype(int).T
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    free[row[inside], column[inside]] = 0
    gaps = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return float((gaps <= _COVERED_PX).mean())


def rows_of(surfels: SurfelFrame, ids: Any) -> tuple[F64, BoolArray, BoolArray, F64]:
    """(N, 2) pixels, (N,) whether tracked, whether confirmed, and the confidence, by ids."""
    where, confidence = np.zeros((len(ids), 2)), np.zeros(len(ids))
    alive, confirmed = np.zeros(len(ids), np.bool_), np.zeros(len(ids), np.bool_)
    _, mine, there = np.intersect1d(ids, surfels.ids, assume_unique=True, return_indices=True)
    where[mine] = surfels.points_px[there]
    alive[mine] = surfels.state[there] == SurfelState.TRACKED
    confirmed[mine], confidence[mine] = surfels.confirmed[there] > 0, surfels.confidence[there]
    return where, alive, confirmed, confidence


def _near(where: F64, truth: F64) -> BoolArray:
    """(N,) which are within 3 px of the reference, if there is one."""
    known = np.isfinite(truth[:, :1])
    off = np.linalg.norm(where - np.where(known, truth, 0.0), axis=1)
    return known[:, 0] & (off <= _RIGHT_PX)


def judge(where: F64, alive: BoolArray, truth: F64) -> tuple[float, float, float]:
    """Shares: alive of all; right of those with a reference; wrong of the alive ones with one."""
    known, near = np.isfinite(truth[:, 0]), _near(where, truth)
    right, wrong = alive & known & near, alive & known & ~near
    return (
        float(alive.mean()),
        float(right.sum() / max(1, known.sum())),
        float(wrong.sum() / max(1, (alive & known).sum())),
    )


def lucas_kanade(images: Sequence[U8], points: F64) -> tuple[list[F64], list[BoolArray]]:
    """Places (N, 2) and who lives (N,) in each frame: frame to frame, checked backwards."""
    here = points.astype(np.float32)
    flow, kept = [points], [np.ones(len(points), np.bool_)]
    for before, now in pairwise(images):
        there, good, _ = cv2.calcOpticalFlowPyrLK(before, now, here, None, **_LK)  # type: ignore[call-overload]
        back, returned, _ = cv2.calcOpticalFlowPyrLK(now, before, there, None, **_LK)  # type: ignore[call-overload]
        fits = np.linalg.norm(back - here, axis=1) < _RETURN_PX
        kept.append(kept[-1] & (good.ravel() > 0) & (returned.ravel() > 0) & fits)
        flow.append(there.astype(np.float64))
        here = there
    return flow, kept


def first_frame_reference(
    images: Sequence[U8], points: F64, flow: Sequence[F64], kept: Sequence[BoolArray],
    wanted: Sequence[int],
) -> dict[int, F64]:  # fmt: skip
    """(N, 2) places of the first frame's patches, NaN where none is like them.

    In every third frame and in those wanted.

    Searched from where Lucas-Kanade lives, and else from where the neighbours that have a reference
    have gone, there by a template search first.
    """
    n = len(points)
    patches = [_crop(images[0], point, _HALF) for point in points]
    affines = np.tile(np.eye(2), (n, 1, 1))
    gaps = np.linalg.norm(points[:, None] - points[None], axis=2)
    out = {0: points.copy()}
    for frame in sorted({*range(_EVERY, len(images), _EVERY), *wanted} - {0}):
        found = np.full((n, 2), np.nan)
        for k in np.flatnonzero(kept[frame]):
            found[k] = _align(images[frame], patches[k], flow[frame][k], affines[k])
        known = np.isfinite(found[:, 0])
        moves = found - points
        for k in np.flatnonzero(~known) if known.any() else ():
            near = np.argsort(np.where(known, gaps[k], np.inf), kind="stable")[:_NEIGHBOURS]
            near = near[known[near]]
            place = points[k] + np.median(moves[near], axis=0)
            place = _search(images[frame], patches[k], place)
            found[k] = _align(images[frame], patches[k], place, affines[k])
        out[frame] = found
    return out


def _crop(image: U8, point: F64, half: int) -> U8:
    """(2 half + 1) squared grey levels about a point, the border repeated outside of the image."""
    u, v = np.rint(point).astype(int)
    padded = cv2.copyMakeBorder(
        image[max(v - half, 0) : max(v + half + 1, 0), max(u - half, 0) : max(u + half + 1, 0)],
        max(half - v, 0), max(v + half + 1 - image.shape[0], 0),
        max(half - u, 0), max(u + half + 1 - image.shape[1], 0), cv2.BORDER_CONSTANT,
    )  # fmt: skip
    return padded.astype(np.uint8)


def _within(image: U8, place: F64) -> bool:
    height, width = image.shape
    return 0.0 <= place[0] < width and 0.0 <= place[1] < height


def _search(image: U8, patch: U8, place: F64) -> F64:
    """Where about a place the patch correlates best, to whole pixels."""
    if not _within(image, place):
        return place
    scores = cv2.matchTemplate(_crop(image, place, _HALF + _MARGIN), patch, cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(int(np.argmax(scores)), scores.shape)
    return np.rint(place) + np.array([int(column), int(row)]) - _MARGIN


def _align(image: U8, patch: U8, place: F64, affine: F64) -> F64:
    """The place of a patch by ECC from a guess, or NaN.  affine: (2, 2), in and out."""
    nothing = np.full(2, np.nan)
    if not np.isfinite(place).all() or not _within(image, place):
        return nothing
    middle, half = np.rint(place), _HALF + _MARGIN
    at = half + place - middle  # in the crop
    warp = np.column_stack([affine, at - affine @ (_HALF, _HALF)]).astype(np.float32)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
    around = _crop(image, place, half)
    try:
        score, warp = cv2.findTransformECC(
            patch, around, warp, cv2.MOTION_AFFINE, stop, np.full_like(around, 255), 3
        )
    except cv2.error:  # it has left the crop
        return nothing
    found = warp[:, :2] @ (_HALF, _HALF) + warp[:, 2]
    if score < _MIN_CORRELATION or np.abs(found - at).max() > _MARGIN:
        return nothing
    affine[:] = warp[:, :2]
    return np.asarray(found - half + middle, np.float64)
