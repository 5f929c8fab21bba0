"""Cameras and surfels of a run by the map of the whole of it.

While it runs, surfels have their camera from the equilibrium or from the last seconds, and their
depth from their birth.  The final map knows both better.  So each frame has its camera by the map,
and each surfel a depth by the landmarks around it.  A surfel keeps its pixel.

**Depth.**  With f(t) the depth of the landmarks around a surfel by its own, there are two estimates
of its depth z(t).  The landmarks' is f(t) z(t), and its own, without the error of its birth, is
z(t) median(f).  The first errs where camera and deformation are confused, the second as the surfel
drifts.  Their geometric mean is the result.  f is measured some times a second, and is linear
between.

**World and unit** stay those in which the surfels of a segment start: its first frame has the
camera that it had, and the landmarks there have the depths that the surfels had.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated, TypeVar

import numpy as np

from pliant.algorithms.arrays import F32, F64, I64, BoolArray, Shape
from pliant.algorithms.deformable.followed_map import SeenMap
from pliant.algorithms.deformable.judged_map import INTERVAL_NS
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState

_AROUND = 8
"""Landmarks around a surfel: 6 to 12 are within a tenth of each other."""
_FLAT = 0.05
"""Prior of the slope of their plane: a third of them beside the surfel does not determine it."""
_SAME = 0.02
"""Share of the depth within which they lie on a plane: otherwise an edge may be between them."""

_FEWEST = 30
"""Surfels that determine the unit."""

_Surfels = TypeVar("_Surfels", bound=SurfelFrame)


@dataclass(frozen=True, kw_only=True)
class FinalSurfels:
    """What the final map says about the surfels of a recording.

    frames, T_world_camera: of F frames, in the world of the surfels.
    segments, ids, factor_stamps_ns, factors: R factors by which the depths of surfels are to be
    multiplied at some times; ordered by segment, id and time.
    """

    frames: Annotated[I64, Shape("F")]
    T_world_camera: Annotated[F64, Shape("F", 4, 4)]
    segments: Annotated[I64, Shape("R")]
    ids: Annotated[I64, Shape("R")]
    factor_stamps_ns: Annotated[I64, Shape("R")]
    factors: Annotated[F32, Shape("R")]

    def corrected(self, surfels: _Surfels, stamp_ns: int) -> _Surfels:
        """Surfels of a frame with the final camera and depths; as they are if it has none."""
        row = int(np.searchsorted(self.frames, surfels.frame))
        if row == len(self.frames) or self.frames[row] != surfels.frame:
            return surfels
        factors = self._factors_of(surfels, stamp_ns)
        T, T_final = surfels.T_world_camera, self.T_world_camera[row]
        R = T_final[:3, :3] @ T[:3, :3].T

        def moved(points: F64) -> F64:
            by = factors if len(points) else factors[:0]
            return transform(T_final, by[:, None] * transform(inverse(T), points))

        return replace(
            surfels,
            T_world_camera=T_final.copy(),
            positions=moved(surfels.positions),
            tangents=factors[:, None, None] * (R @ surfels.tangents),
            sigma=(factors * surfels.sigma).astype(np.float32),
            tried=moved(surfels.tried),
        )

    def _factors_of(self, surfels: SurfelFrame, stamp_ns: int) -> F64:
        """(N,) at a time; where a surfel was never measured, the median of the others."""
        first, end = np.searchsorted(self.segments, [surfels.segment, surfels.segment + 1])
        ids, stamps_ns = self.ids[first:end], self.factor_stamps_ns[first:end]
        begin, past = (np.searchsorted(ids, surfels.ids, side) for side in ("left", "right"))
        known = begin < past
        out = np.ones(len(surfels.ids))
        if not known.any():
            return out
        begin, past, factors = begin[known], past[known], self.factors[first:end].astype(np.float64)
        # Rows up to this time: rows are ordered by id, then time.
        earlier = np.concatenate([[0], np.cumsum(stamps_ns <= stamp_ns)])
        after = begin + earlier[past] - earlier[begin]
        before, after = np.maximum(after - 1, begin), np.minimum(after, past - 1)
        apart = np.maximum(stamps_ns[after] - stamps_ns[before], 1)
        share = np.clip((stamp_ns - stamps_ns[before]) / apart, 0.0, 1.0)
        out[known] = (1.0 - share) * factors[before] + share * factors[after]
        out[~known] = np.median(out[known])
        return out


@dataclass
class _Segment:
    """unit: of the surfels by that of the map.    T_surfels_map: between their worlds, then.
    frames, online, final: of its frames so far; ``final`` is None where the map is not seen."""

    unit: float = 0.0
    T_surfels_map: F64 = field(default_factory=lambda: np.eye(4))
    measured_ns: int = 0
    frames: list[int] = field(default_factory=list[int])
    stamps_ns: list[int] = field(default_factory=list[int])
    online: list[F64] = field(default_factory=list[F64])
    final: list[F64 | None] = field(default_factory=list[F64 | None])


class SurfelsByMap:
    """Takes the surfels of all frames in order; ``found`` is the result."""

    def __init__(self) -> None:
        self._segments: dict[int, _Segment] = {}
        self._factors: list[tuple[int, I64, int, F32]] = []

    def take(self, surfels: SurfelFrame, stamp_ns: int, seen: SeenMap | None) -> None:
        """A frame whose surfels have a camera, and the final map in it."""
        segment = self._segments.setdefault(surfels.segment, _Segment())
        final = None
        if seen is not None and not surfels.lost:
            final = self._place(segment, surfels, stamp_ns, seen)
        segment.final.append(final)
        segment.frames.append(surfels.frame)
        segment.stamps_ns.append(stamp_ns)
        segment.online.append(surfels.T_world_camera.copy())

    def _place(
        self, segment: _Segment, surfels: SurfelFrame, stamp_ns: int, seen: SeenMap
    ) -> F64 | None:
        """T_world_camera (4, 4) in the world of the surfels; None before that is known."""
        starts = segment.unit == 0.0
        if starts or stamp_ns - segment.measured_ns >= INTERVAL_NS:
            rows, factors = depth_factors(surfels, seen)
            if starts and len(rows) >= _FEWEST:
                segment.unit = 1.0 / float(np.median(factors))
                T_map_camera = _in_unit(seen.T_world_camera, segment.unit)
                segment.T_surfels_map = surfels.T_world_camera @ inverse(T_map_camera)
            elif starts:
                return None
            scaled = (segment.unit * factors).astype(np.float32)
            self._factors.append((surfels.segment, surfels.ids[rows], stamp_ns, scaled))
            segment.measured_ns = stamp_ns
        return segment.T_surfels_map @ _in_unit(seen.T_world_camera, segment.unit)

    def found(self) -> FinalSurfels:
        """Of all frames of the segments that see the map."""
        placed = [segment for segment in self._segments.values() if segment.unit]
        none = np.zeros(0, np.int64)
        frames = np.concatenate([none, *(np.array(each.frames, np.int64) for each in placed)])
        T = np.concatenate([np.zeros((0, 4, 4)), *(_filled(each) for each in placed)])
        counts = [len(ids) for _, ids, _, _ in self._factors]
        segments = np.repeat(np.array([n for n, _, _, _ in self._factors], np.int64), counts)
        ids = np.concatenate([none, *(ids for _, ids, _, _ in self._factors)])
        stamps_ns = np.repeat(np.array([at for _, _, at, _ in self._factors], np.int64), counts)
        factors = np.concatenate([np.zeros(0, np.float32), *(f for _, _, _, f in self._factors)])
        by_frame, order = np.argsort(frames, kind="stable"), np.lexsort((stamps_ns, ids, segments))
        segments, ids = segments[order], ids[order]
        return FinalSurfels(
            frames=frames[by_frame],
            T_world_camera=T[by_frame],
            segments=segments,
            ids=ids,
            factor_stamps_ns=stamps_ns[order],
            factors=_with_medians(segments, ids, factors[order]),
        )


def _with_medians(segments: I64, ids: I64, factors: F32) -> F32:
    """(R,) geometric mean of each factor and the median of its surfel's."""
    changes = (np.diff(segments) != 0) | (np.diff(ids) != 0)
    out = factors.copy()
    for of_surfel in np.split(out, np.flatnonzero(changes) + 1):
        if len(of_surfel):
            of_surfel[:] = np.sqrt(of_surfel * np.median(of_surfel))
    return out


def _filled(segment: _Segment) -> F64:
    """(F, 4, 4) with frames that do not see the map moved as the nearest one that does."""
    stamps_ns = np.array(segment.stamps_ns, np.int64)
    seen = np.array([T is not None for T in segment.final])
    out: list[F64] = []
    for stamp_ns, online, final in zip(stamps_ns, segment.online, segment.final, strict=True):
        if final is None:
            nearest = int(np.flatnonzero(seen)[np.abs(stamps_ns[seen] - stamp_ns).argmin()])
            there = segment.final[nearest]
            assert there is not None
            final = there @ inverse(segment.online[nearest]) @ online
        out.append(final)
    return np.array(out)


def _in_unit(T: F64, unit: float) -> F64:
    out = T.copy()
    out[:3, 3] *= unit
    return out


def depth_factors(surfels: SurfelFrame, seen: SeenMap) -> tuple[I64, F64]:
    """Tracked surfels with landmarks around them, and (S,) depth of these by their own."""
    tracked = np.flatnonzero(surfels.state == SurfelState.TRACKED)
    if not len(tracked) or len(seen.landmarks) < _AROUND:
        return tracked[:0], np.zeros(0)
    own = transform(inverse(surfels.T_world_camera), surfels.positions[tracked])[:, 2]
    depths, certain = depths_around(
        surfels.points_px[tracked].astype(np.float64), seen.points_px, seen.landmarks[:, 2]
    )
    certain &= own > 0.0
    return tracked[certain], depths[certain] / own[certain]


def depths_around(points_px: F64, landmarks_px: F64, depths: F64) -> tuple[F64, BoolArray]:
    """Depths at pixels (N, 2) by landmarks at pixels (L, 2), and whether they are one surface.

    A plane has an inverse depth that is linear in the image: it is fitted to the nearest ones.
    """
    squares = ((points_px[:, None] - landmarks_px) ** 2).sum(axis=2)
    near = np.argsort(squares, axis=1, kind="stable")[:, :_AROUND]
    squares = np.take_along_axis(squares, near, axis=1)
    reach = np.maximum(np.sqrt(squares[:, -1:]), 1.0)
    weights = np.exp(-0.5 * squares / reach**2)
    A = np.ones((*near.shape, 3))
    A[:, :, 1:] = (landmarks_px[near] - points_px[:, None]) / reach[:, :, None]
    inverse_depths = 1.0 / np.maximum(depths, 1e-9)[near]
    H = np.einsum("nka,nk,nkb->nab", A, weights, A) + np.diag([0.0, _FLAT, _FLAT])
    plane = np.linalg.solve(H, np.einsum("nka,nk,nk->na", A, weights, inverse_depths)[:, :, None])
    off = (A @ plane)[:, :, 0] / inverse_depths - 1.0
    here = plane[:, 0, 0]
    spread = np.sqrt((weights * off**2).sum(axis=1) / weights.sum(axis=1))
    certain = (here > 0.0) & (spread < _SAME)
    return 1.0 / np.where(certain, here, 1.0), certain
