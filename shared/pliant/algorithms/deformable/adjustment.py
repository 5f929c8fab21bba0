"""Adjusts cameras, rest shape and displacements of a deforming scene together.

Unknowns: the camera (R_k, c_k) of each keyframe, the rest place X_i of each landmark, and a
displacement d_nk of each node of a graph in each keyframe.  A landmark follows its nodes,

    P_ik = X_i + sum_n w_in d_nk,     sum_n w_in = 1,

and the cost is, with the Cauchy kernel rho and edges (m, n) of length l and direction e,

    sum rho(|project(R_k^T (P_ik - c_k)) - z_ik|^2 / noise^2)
      + sum_k sum_(m,n) |d_nk - d_mk|^2 / (gradient l)^2            smooth in space
      + sum_k sum_(m,n) (e . (d_nk - d_mk))^2 / (strain l)^2        elastic: lengths are kept
      + K sum_n x_n / (1 + x_n),   x_n = mean_k |d_nk|^2 / size^2   gauge: most nodes are stiff

**What can be observed.**  One image determines two of the three coordinates of a moving point.  The
third comes from its neighbours: lengths are kept, and the rest shape has been seen from many sides.
A motion that all landmarks share looks like a motion of the camera.  The last term decides: its
Geman-McClure cost is the rigidity of a node, w_n = (1 + x_n)^-2, so the stiff part of the scene
determines the camera, and a node that moves is hardly pulled.  Its mean displacement over time is
zero, which defines the rest place.  Where everything in view moves in every keyframe, the common
part of the motion is in the camera.

The elastic regulariser is that of NR-SLAM (Rodriguez et al. 2023), linear in the displacements.
The graph is that of embedded deformation (Sumner et al. 2007), without rotations.  Viscous edges
between keyframes were neutral and are left out.

A Gauss-Newton step eliminates the landmarks without making the matrix that results,

    S = H - sum_i W_i H_i^-1 W_i^T,

by conjugate gradients.  H has one dense block for each keyframe, whose inverse preconditions; it is
made anew in every third step.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.deformable.conjugate_gradients import conjugate_gradients
from pliant.algorithms.deformable.held_out import KERNEL_PX, triangulate
from pliant.algorithms.deformable.linearised import (
    CAMERA,
    accumulate,
    linearise,
    times,
    times_transposed,
)
from pliant.algorithms.deformable.moving_landmarks import NEAREST, DeformingMap, TrackedPoints
from pliant.algorithms.deformable.node_graph import NodeGraph, no_nodes, node_graph
from pliant.algorithms.deformable.priors import Prior
from pliant.algorithms.geometry import so3_exp

NOISE_PX = 0.5
"""Standard deviation of a track."""
_SPACING = 0.2
"""Between nodes, as a share of the median depth."""
_CERTAIN = 0.01
"""Standard deviation of a reliable rest place, as a share of the median depth."""
_FIRST_DAMPING, _LEAST_DAMPING = 1e-4, 1e-7
_REGULAR = 1e-6
"""Damping of what nothing determines."""
_HELD = 1e12
"""Damping of the first camera, which is the world."""
_RIGID_STEPS, _STEPS = 4, 12
_INVERTED_EVERY = 3
"""Steps with the same inverses of the blocks."""
_TOLERANCE, _PRODUCTS = 1e-2, 80
"""Of conjugate gradients."""


@dataclass(frozen=True)
class _State:
    T: F64  # (K, 4, 4)
    rest: F64  # (L, 3)
    d: F64  # (K, N, 3)


@dataclass
class _Linearised:
    """J_camera (M, 2, 6), J_point (M, 2, 3), r (M, 2), and px squared (M,)."""

    J_camera: F64
    J_point: F64
    r: F64
    squares: F64
    cost: float


def adjust_deforming(
    tracks: TrackedPoints, T_world_camera: F64, camera: PinholeCamera
) -> DeformingMap:
    """Adjust all keyframes.

    T_world_camera: (K, 4, 4) start, as from a rigid map.  The first one stays as it is; unit and
    world of the result are those of the start.    Raises ValueError where the tracks determine no
    graph.
    """
    if len(np.unique(tracks.landmarks)) < NEAREST:
        raise ValueError("too few landmarks")
    T_start, rest, unit = _start(tracks, T_world_camera, camera)
    # A rigid adjustment first: nodes must not explain errors of the start.
    none = np.zeros((len(T_start), 0, 3))
    rigid = _Adjustment(tracks, camera, no_nodes(len(rest)))
    state = rigid.minimised(_State(T_start, rest, none), _RIGID_STEPS)
    T_rigid = state.T
    graph = node_graph(state.rest, _SPACING)
    d = np.zeros((len(T_start), len(graph.nodes), 3))
    whole = _Adjustment(tracks, camera, graph)
    state = whole.minimised(_State(state.T, state.rest, d), _STEPS)
    return DeformingMap(
        T_world_camera=_in_unit(state.T, unit),
        T_rigid=_in_unit(T_rigid, unit),
        depth=unit,
        spacing=unit * graph.spacing,
        rest=unit * state.rest,
        nodes=unit * graph.nodes,
        displacements=unit * state.d,
        carriers=graph.carriers,
        weights=graph.weights,
        reliable=whole.reliable(state),
    )


def _in_unit(T: F64, unit: float) -> F64:
    out = T.copy()
    out[:, :3, 3] *= unit
    return out


def _start(
    tracks: TrackedPoints, T_world_camera: F64, camera: PinholeCamera
) -> tuple[F64, F64, float]:
    """Poses and landmarks in units of the median depth, and that unit."""
    k, i = tracks.keyframes, tracks.landmarks
    count = int(i.max()) + 1 if len(i) else 0
    rays = np.concatenate([camera.normalise(tracks.points_px), np.ones((len(k), 1))], axis=1)
    rays = np.einsum("mij,mj->mi", T_world_camera[k, :3, :3], rays)
    centres = T_world_camera[k, :3, 3]
    rest = triangulate(i, rays, centres, count)
    depths = np.einsum("mi,mi->m", T_world_camera[k, :3, 2], rest[i] - centres)
    unit = float(np.median(depths[depths > 0.0])) if (depths > 0.0).any() else 1.0
    return _in_unit(T_world_camera, 1.0 / unit), rest / unit, unit


def _distance(state: _State) -> float:
    """Median distance of the landmarks from the first camera."""
    return float(np.median(np.linalg.norm(state.rest - state.T[0, :3, 3], axis=1)))


def _scaled(state: _State, scale: float) -> _State:
    """Scaled about the first camera: no pixel changes."""
    centre, T = state.T[0, :3, 3], state.T.copy()
    T[:, :3, 3] = centre + scale * (T[:, :3, 3] - centre)
    return _State(T, centre + scale * (state.rest - centre), scale * state.d)


class _Adjustment:
    """Damped Gauss-Newton steps."""

    def __init__(self, tracks: TrackedPoints, camera: PinholeCamera, graph: NodeGraph) -> None:
        self._tracks, self._intrinsics, self._graph = tracks, camera.intrinsics, graph
        self._prior = Prior(graph)
        self._damping = _FIRST_DAMPING
        self._inverse = np.zeros((0, 0, 0))

    def minimised(self, state: _State, steps: int) -> _State:
        """Try this many steps; each that decreases the cost is taken.

        The unit is kept: otherwise the map would shrink, and its displacements with it.
        """
        now, distance = self.linearised(state), _distance(state)
        for step in range(steps):
            moved = self._stepped(state, now, step % _INVERTED_EVERY == 0)
            moved = _scaled(moved, distance / _distance(moved))
            then = self.linearised(moved)
            if then.cost + self._prior_cost(moved) < now.cost + self._prior_cost(state):
                state, now = moved, then
                self._damping = max(0.1 * self._damping, _LEAST_DAMPING)
                self._prior.update_rigidity(state.d)
            else:
                self._damping *= 30.0
        return state

    def linearised(self, state: _State) -> _Linearised:
        """Errors and derivatives at a state."""
        t = self._tracks
        count = len(t.keyframes)
        J_camera, J_point = np.empty((count, 2, CAMERA)), np.empty((count, 2, 3))
        r, squares = np.empty((count, 2)), np.empty(count)
        cost = linearise(
            *(t.keyframes, t.landmarks, t.points_px, self._intrinsics, state.T, state.rest),
            *(state.d, self._graph.carriers, self._graph.weights, NOISE_PX, KERNEL_PX),
            *(J_camera, J_point, r, squares),
        )
        return _Linearised(J_camera, J_point, r, squares, cost)

    def reliable(self, state: _State) -> BoolArray:
        """(L,) see ``DeformingMap``."""
        now, landmarks = self.linearised(state), self._tracks.landmarks
        count = len(state.rest)
        H = np.zeros((count, 3, 3))
        np.add.at(H, landmarks, np.einsum("mra,mrb->mab", now.J_point, now.J_point))
        # The least eigenvalue is the inverse of the largest variance.
        certain = np.linalg.eigvalsh(H)[:, 0] > 1.0 / _CERTAIN**2
        squares = np.bincount(landmarks, np.minimum(now.squares, 1e6), count)
        fits = squares < KERNEL_PX**2 * np.bincount(landmarks, minlength=count)
        return certain & fits

    def _prior_cost(self, state: _State) -> float:
        return float(np.vdot(state.d, self._prior.gradient(state.d)))

    def _stepped(self, state: _State, now: _Linearised, inverting: bool) -> _State:
        """One step: landmarks eliminated, the rest by conjugate gradients."""
        t, graph = self._tracks, self._graph
        table = (t.keyframes, t.landmarks, graph.carriers, graph.weights, now.J_camera, now.J_point)
        K, L = len(state.T), len(state.rest)
        B = CAMERA + 3 * len(graph.nodes)
        H, g = np.zeros((K, B, B)), np.zeros((K, B))
        H_point, g_point = np.zeros((L, 3, 3)), np.zeros((L, 3))
        accumulate(*table, now.r, H, g, H_point, g_point)
        H[:, CAMERA:, CAMERA:] += self._prior.matrix
        g[:, CAMERA:] += self._prior.gradient(state.d).reshape(K, -1)
        at = np.arange(B)
        extra = self._damping * H[:, at, at] + _REGULAR
        extra[0, :CAMERA] = _HELD
        H[:, at, at] += extra
        axes = np.arange(3)
        H_point[:, axes, axes] *= 1.0 + self._damping
        H_point[:, axes, axes] += _REGULAR
        inverse_point = np.linalg.inv(H_point)

        def of_points(v: F64) -> F64:
            return np.einsum("lab,lb->la", inverse_point, v)

        def product(v: F64) -> F64:
            u, by_point = np.empty((len(t.keyframes), 2)), np.zeros((L, 3))
            times(*table, v, u, by_point)
            out = extra * v
            nodes = v[:, CAMERA:].reshape(K, -1, 3)
            out[:, CAMERA:] += self._prior.gradient(nodes).reshape(K, -1)
            times_transposed(*table, u, of_points(by_point), out)
            return out

        b = -g
        times_transposed(*table, np.zeros((len(t.keyframes), 2)), of_points(-g_point), b)
        # b = -(g - W H^-1 g_point): the kernel subtracts J_point x, so x is -H^-1 g_point.
        if inverting:
            self._inverse = np.asarray(np.linalg.inv(H), np.float64)

        def precondition(v: F64) -> F64:
            return np.einsum("kab,kb->ka", self._inverse, v)

        x = conjugate_gradients(product, precondition, b, tolerance=_TOLERANCE, limit=_PRODUCTS)
        u, by_point = np.empty((len(t.keyframes), 2)), np.zeros((L, 3))
        times(*table, x, u, by_point)
        T = state.T.copy()
        T[:, :3, :3] = T[:, :3, :3] @ so3_exp(x[:, :3])
        T[:, :3, 3] += x[:, 3:CAMERA]
        return _State(
            T=T,
            rest=state.rest - of_points(g_point + by_point),
            d=state.d + x[:, CAMERA:].reshape(state.d.shape),
        )
