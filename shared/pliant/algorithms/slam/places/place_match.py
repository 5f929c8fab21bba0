"""Two similar keyframes: whether they show the same place, and the similarity between their maps.

For loops and for merges of segments.  Corners propose a similarity; the map's landmarks decide.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.slam.locate.landmark_search import MIN_AGREEING, RANSAC_SAMPLES
from pliant.algorithms.slam.locate.localisation import RANSAC_GATE_PX
from pliant.algorithms.slam.locate.point_patches import look_alike
from pliant.algorithms.slam.locate.pose_quality import MIN_SPREAD
from pliant.algorithms.slam.locate.reacquisition import MaximaGrid
from pliant.algorithms.slam.map.landmarks import MAPPED, Landmarks
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.places.place_index import match
from pliant.algorithms.slam.places.relocalisation import Place, corners_in_map, repeats
from pliant.algorithms.slam.places.similarity import Pairs, refine_similarity, similarity_by_ransac


@dataclass(frozen=True, kw_only=True)
class PlaceMatch:
    """The common landmarks of two keyframes.

    S_old_new: (4, 4) similarity, ``X_old = S_old_new X_new``, between the worlds of their segments;
    in one segment: the drift of the newer one.
    rows: (n, 2) rows of landmarks that are the same, old and new; a row at most once in each
    column.
    """

    S_old_new: F64
    rows: I32


Refusal = Literal["few_corners", "few_points", "one_spot", "repeated"]
"""Why two keyframes do not verifiably show the same place: too few corners agree on a similarity,
too few landmarks agree, all agreeing ones lie in one spot of the image, or the image repeats a step
aside.
"""


def match_places(
    old: Place,
    new: Place,
    points: Landmarks,
    camera: PinholeCamera,
    parameters: MappingParameters,
    generator: np.random.Generator,
) -> PlaceMatch | Refusal:
    """Return the evidence that both keyframes show the same place, or why there is none.

    Similar corners and landmarks in both images must agree on the similarity, as many as a pose
    needs, and not in one spot.
    """
    limits = parameters.localisation
    alike = match(old.features, new.features)
    corners: list[tuple[F64, F64]] = []
    known = np.ones(len(alike), np.bool_)
    for place, column in ((old, 0), (new, 1)):
        xyz, deep = corners_in_map(place.keyframe, place.features, points, camera)
        here = transform(inverse(place.keyframe.T_world_camera), xyz)[alike[:, column]]
        seen = camera.normalise(place.features.points_px[alike[:, column]].astype(np.float64))
        corners.append((here, seen))
        known &= deep[alike[:, column]]
    (xyz_a, seen_a), (xyz_b, seen_b) = corners
    if np.count_nonzero(known) < MIN_AGREEING:
        return "few_corners"
    pairs = Pairs(xyz_a=xyz_a, xyz_b=xyz_b, seen_a=seen_a, seen_b=seen_b).of(known)
    found = similarity_by_ransac(
        pairs, generator, gate=RANSAC_GATE_PX / camera.fx,
        samples=RANSAC_SAMPLES,
    )  # fmt: skip
    if found is None or found[1].sum() < MIN_AGREEING:
        return "few_corners"
    S_a_b, agreeing = found
    rows, points_px = np.zeros((0, 2), np.int32), np.zeros((0, 2), np.float32)
    for gate_px in (RANSAC_GATE_PX, limits.inlier_px):
        rows, guided, points_px = _guided(
            S_a_b, old, new, points, camera, gate_px, parameters.reacquisition.min_zncc
        )
        if len(rows) < limits.min_inliers:
            return "few_points"
        S_a_b = refine_similarity(S_a_b, guided, scale=gate_px / camera.fx)
    spread = (points_px.std(axis=0) / np.array([camera.width, camera.height])).min()
    if spread < MIN_SPREAD:
        return "one_spot"
    agreeing_corners = alike[known][agreeing, 1]
    if repeats(new.features, agreeing_corners, pairs.xyz_b[agreeing], camera):
        return "repeated"
    return PlaceMatch(S_old_new=_between_worlds(S_a_b, old, new), rows=rows)


def _between_worlds(S_a_b: F64, old: Place, new: Place) -> F64:
    """Convert a similarity between two keyframes to one between their worlds."""
    return old.keyframe.T_world_camera @ S_a_b @ inverse(new.keyframe.T_world_camera)


def _guided(
    S_a_b: F64,
    old: Place,
    new: Place,
    points: Landmarks,
    camera: PinholeCamera,
    gate_px: float,
    min_zncc: float,
) -> tuple[I32, Pairs, F32]:
    """Match similar landmarks of the old and the new keyframe that each sees where the other one
    has its
    own: two dense maps of the same surfaces have many neighbours by position alone.

    Returns their rows (n, 2), themselves, and where the old keyframe saw them.
    """
    rows: list[I32] = []
    places: list[F32] = []
    here: list[F64] = []
    for place in (old, new):
        mapped = points.state[place.keyframe.rows] == MAPPED
        rows.append(place.keyframe.rows[mapped])
        places.append(place.keyframe.points_px[mapped])
        here.append(transform(inverse(place.keyframe.T_world_camera), points.xyz[rows[-1]]))
    to_new = transform(np.asarray(np.linalg.inv(S_a_b), np.float64), here[0])
    to_old = transform(S_a_b, here[1])
    nearest = _nearest(to_new, places[1], camera, gate_px)
    back = _nearest(to_old, places[0], camera, gate_px)
    a = np.flatnonzero(nearest >= 0)
    a = a[back[nearest[a]] == a]
    a = a[points.kappas[rows[0][a]] * points.kappas[rows[1][nearest[a]]] > 0.0]
    S_old_new = _between_worlds(S_a_b, old, new)
    paired = np.column_stack([rows[0][a], rows[1][nearest[a]]])
    a = a[look_alike(S_old_new, paired, old.segment, new.segment, points, min_zncc)]
    b = nearest[a]
    seen = [camera.normalise(px.astype(np.float64)) for px in (places[0][a], places[1][b])]
    pairs = Pairs(xyz_a=here[0][a], xyz_b=here[1][b], seen_a=seen[0], seen_b=seen[1])
    return np.column_stack([rows[0][a], rows[1][b]]), pairs, places[0][a]


def _nearest(points_camera: F64, points_px: F32, camera: PinholeCamera, gate_px: float) -> I32:
    """(N,) index of the pixel nearest to the projection of a landmark, -1 without one."""
    seen = np.column_stack([points_px, np.zeros(len(points_px), np.float32)])
    grid = MaximaGrid.build(seen, camera.width, camera.height, gate_px)
    front = points_camera[:, 2] > 0.0
    ahead = np.where(front[:, None], points_camera, np.array([0.0, 0.0, 1.0]))
    places = camera.project(ahead)
    inside = front & (places >= 0.0).all(axis=1)
    inside &= (places < (camera.width, camera.height)).all(axis=1)
    nearest = grid.nearest(np.where(inside[:, None], places, 0.0).astype(np.float32), gate_px)
    return np.where(inside, nearest, -1).astype(np.int32)
