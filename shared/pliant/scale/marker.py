"""The scale of a map from printed markers of a known size that its images show."""

from collections import defaultdict
from typing import Any

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.slam.estimate.triangulation import triangulate
from pliant.errors import ResultError
from pliant.export.images import camera_of, rectified_images
from pliant.export.posed_images import IdealCamera
from pliant.recording.reader import Recording
from pliant.results.known_scale import Scale
from pliant.results.run import Run
from pliant.wording import counted

_DICTIONARIES = ("4X4_250", "5X5_250", "6X6_250", "7X7_250", "ARUCO_ORIGINAL", "APRILTAG_36H11")
_LEAST_VIEWS = 3
_MAX_SPREAD = 0.05
"""Maximum spread of a square's sides, diagonals and corner depths, as a share of its side."""

_Marker = tuple[str, int]
"""Dictionary and number."""


def from_marker(recording: Recording, run: Run, metres: float) -> Scale:
    """By all markers that keyframes see, whose black squares have sides of that many metres.

    A marker counts where at least three keyframes see it and its corners, triangulated, are a
    square.  The scale is the median of what they tell.  Raises ResultError.
    """
    if not 0.0 < metres < np.inf:
        raise ResultError(f"--marker {metres:g}: expected a positive length")
    ideal = IdealCamera(run)
    measured: list[tuple[float, float]] = []
    found = _markers(recording, ideal)
    for views in found.values():
        side = _side(views, ideal)
        if side is not None:
            measured.append((metres / side[0], side[1]))
    if not measured:
        seen = f"{len(found)} found, but none as a square in {_LEAST_VIEWS} keyframes"
        raise ResultError(
            f"{recording.path}: no marker: {seen if found else 'keyframes see none'} (ArUco, or "
            "AprilTag 36h11; film it from several sides)"
        )
    factors, spreads = np.array(measured).T
    sigma = float(np.median(spreads))
    source = f"{counted(len(measured), 'marker')} of {metres:g} m"
    return Scale(metres_per_unit=float(np.median(factors)), sigma=sigma, source=source)


def _markers(recording: Recording, ideal: IdealCamera) -> dict[_Marker, dict[int, F32]]:
    """Corners (4, 2) of each marker by the keyframe's frame; of twins in an image neither."""
    aruco: Any = cv2.aruco
    options = aruco.DetectorParameters()
    # Of the methods the one whose corners are not drawn inwards; its pixels begin at their corners.
    options.cornerRefinementMethod = aruco.CORNER_REFINE_APRILTAG
    detectors = {
        name: aruco.ArucoDetector(
            aruco.getPredefinedDictionary(getattr(aruco, f"DICT_{name}")), options
        )
        for name in _DICTIONARIES
    }
    found: dict[_Marker, dict[int, F32]] = defaultdict(dict)
    for frame, _, pixels, _ in rectified_images(recording, camera_of(recording), ideal.keyframes):
        image = ideal.image(frame, pixels)
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        for name, detector in detectors.items():
            corners, numbers, _ = detector.detectMarkers(grey)
            listed = [] if numbers is None else numbers.ravel().tolist()
            for number, four in zip(listed, corners, strict=True):
                if listed.count(number) == 1:
                    found[name, number][frame] = np.float32(four).reshape(4, 2) - 0.5
    return found


def _side(views: dict[int, F32], ideal: IdealCamera) -> tuple[float, float] | None:
    """Length of a marker's side in units of the map, and its standard deviation as a share."""
    if len(views) < _LEAST_VIEWS:
        return None
    poses: F64 = np.array([ideal.poses[frame] for frame in views])
    px = np.array(list(views.values()))
    u, v = (np.ascontiguousarray(px[..., axis]) for axis in (0, 1))
    seen = np.ones(u.shape, np.bool_)
    corners, errors, _, sigmas = triangulate(poses, u, v, seen, np.arange(4), ideal.camera)
    if not np.isfinite(errors).all() or sigmas.max() > _MAX_SPREAD:
        return None
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
    diagonals = np.linalg.norm(corners[:2] - corners[2:], axis=1) / np.sqrt(2.0)
    lengths = np.concatenate([sides, diagonals])
    spread = float(lengths.std() / lengths.mean())
    if spread > _MAX_SPREAD:
        return None
    return float(lengths.mean()), spread
