"""Loop closing: how the drift since an earlier visit is distributed, and which landmarks are
merged.

Place recognition verifies that two keyframes see the same place, and the similarity between the
world as each of them maps it.  A pose graph of similarities distributes the drift over all
keyframes between them.  Landmarks move with their reference keyframes, and duplicates are merged.
The next global bundle adjustment refines the result.
"""

from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F64, I32, I64, BoolArray
from pliant.algorithms.geometry import inverse, matrix_to_similarity
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.slam.adjust.final_adjustment import ObservationList
from pliant.algorithms.slam.estimate.pose_graph import Edges, optimise_pose_graph
from pliant.algorithms.slam.map.landmarks import MAPPED, Landmarks
from pliant.compiler.kernel import kernel

_COVISIBLE_SHARE = 0.3
"""Minimum share of common landmarks, of the keyframe with fewer, for an edge."""

_FOLLOWING_SHARE = 0.02
"""The same for consecutive keyframes: with fewer the camera was elsewhere in between."""

_DEPTHS = 10.0
"""Square root of the number of a keyframe's depths with independent errors."""

_ACCEPTED = 0.5
"""Weight of a loop below which the others contradict it."""

_LEAST = 1e-6
"""Minimum depth of a keyframe, and of its sigma."""


class Loop(NamedTuple):
    """Two keyframes that see the same place.

    old, new: ids of the keyframes.    S_old_new: (4, 4) similarity that moves the world of the new
    one to that of the old one.    rows, ids: (n, 2) of landmarks that are the same, the old one
    first.
    """

    old: int
    new: int
    S_old_new: F64
    rows: I32
    ids: I64

    def living(self, points: Landmarks) -> "Loop":
        """Return the loop with the landmarks that still exist."""
        alive = points.ids[self.rows] == self.ids
        alive &= points.state[self.rows] == MAPPED
        alive = alive.all(axis=1)
        return self if alive.all() else self._replace(rows=self.rows[alive], ids=self.ids[alive])


def close_loops(
    seen: ObservationList, keyframe_ids: I64, sigmas: F64, loops: list[Loop], focal_px: float
) -> tuple[MapMoves, list[Loop]]:
    """Return how the map moves with its keyframes when loops are closed; the first keyframe is
    fixed.

    keyframe_ids: (M,) of its cameras, ascending.   sigmas: (N,) relative sigmas of depths. Also
    returns the loops that were not contradicted.
    """
    ends = np.searchsorted(keyframe_ids, [(loop.old, loop.new) for loop in loops])
    edges = _edges(seen, sigmas, loops, ends.astype(np.int32), focal_px)
    S = seen.T_world_camera
    found, weights = optimise_pose_graph(S, edges, np.arange(len(S)) == 0)
    moves = matrix_to_similarity(found @ inverse(S))
    fits = weights[len(weights) - len(loops) :] > _ACCEPTED
    accepted = [loop for loop, fit in zip(loops, fits, strict=True) if fit]
    return MapMoves(keyframe_ids=keyframe_ids, moves=moves), accepted


def _edges(
    seen: ObservationList, sigmas: F64, loops: list[Loop], ends: I32, focal_px: float
) -> Edges:
    """Edges between consecutive and covisible keyframes, then the loops.

    If the camera was lost between two consecutive keyframes, the second one is placed by landmarks
    of earlier ones, or by the loops: the step itself is no information.

    The uncertainty between two keyframes is that of one point, at 1 px: drift is the sum of errors
    that all their points share.  Depths, and so the scale, have independent errors, as small as the
    parallax allows.
    """
    M = len(seen.T_world_camera)
    order = np.argsort(seen.point, kind="stable")
    starts = np.searchsorted(seen.point[order], np.arange(len(seen.rows) + 1))
    shared = np.zeros((M, M), np.int32)
    _count_shared(seen.camera[order], starts, shared)
    own = np.diag(shared)
    enough = np.zeros((M, M), np.bool_)
    _meet_again(shared, _COVISIBLE_SHARE, enough)
    following = np.arange(1, M)
    follow = shared[following, following - 1] >= _FOLLOWING_SHARE * np.minimum(own[1:], own[:-1])
    enough[following, following - 1] = follow
    jumps = following[~follow]
    if len(jumps):
        # A recognised camera keeps its place, whatever a loop implies.
        before = np.where(np.arange(M) < jumps[:, None], shared[jumps], 0)
        best = before.argmax(axis=1)
        enough[jumps, best] |= before.max(axis=1) >= _FOLLOWING_SHARE * np.minimum(
            own[jumps], own[best]
        )
        enough[jumps, jumps - 1] = _apart(enough, ends, jumps)
    j, i = np.nonzero(enough)
    S = seen.T_world_camera
    Z = inverse(S[i]) @ S[j]
    of_loops = [
        inverse(S[old]) @ loop.S_old_new @ S[new]
        for loop, (old, new) in zip(loops, ends.tolist(), strict=True)
    ]
    i, j = np.concatenate([np.column_stack([i, j]), ends]).astype(np.int32).T
    depth = np.maximum(seen.medians(seen.depths(), seen.camera), _LEAST)
    sigma = np.maximum(seen.medians(sigmas[seen.point], seen.camera), _LEAST)
    bearing = np.full(len(i), 1.0 / focal_px)
    return Edges(
        i=i.copy(), j=j.copy(), Z=np.concatenate([Z, np.array(of_loops).reshape(-1, 4, 4)]),
        sigmas=np.column_stack([bearing] * 3 + [bearing * depth[j]] * 3 + [sigma[j] / _DEPTHS]),
        doubtful=np.arange(len(i)) >= len(i) - len(loops),
    )  # fmt: skip


def _apart(edges: BoolArray, ends: I32, jumps: I64) -> BoolArray:
    """Which of the steps to a keyframe from the one before alone keep the graph connected.

    edges: (M, M).   ends: (L, 2) of the loops.
    """
    group = np.arange(len(edges))

    def meet(a: int, b: int) -> bool:
        apart = bool(group[a] != group[b])
        group[group == group[a]] = group[b]
        return apart

    for a, b in [*np.argwhere(edges).tolist(), *ends.tolist()]:
        meet(a, b)
    return np.array([meet(jump - 1, jump) for jump in jumps.tolist()])


@kernel
def _meet_again(shared: I32, share: float, enough: BoolArray) -> None:
    """Mark pairs with enough common landmarks, the newer one first.  Within an uninterrupted
    series, consecutive pairs are sufficient.
    """
    for new in range(len(shared)):
        unbroken = True
        for old in range(new - 1, -1, -1):
            sees = shared[new, old] >= share * min(shared[old, old], shared[new, new])
            unbroken = unbroken and sees
            enough[new, old] = sees and not unbroken


@kernel
def _count_shared(camera: I32, starts: I64, shared: I32) -> None:
    """camera: of each observation, by points; those of point n: ``starts[n] : starts[n + 1]``."""
    for n in range(starts.size - 1):
        for a in range(starts[n], starts[n + 1]):
            for c in range(starts[n], a + 1):
                shared[camera[a], camera[c]] += 1
                if a != c:
                    shared[camera[c], camera[a]] += 1
