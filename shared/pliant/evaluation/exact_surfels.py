"""Surfels compared with exact ground truth: the material points on which they were created.

Metric, untrimmed, without any alignment.  The world is the camera of the frame in which the surfels
start, for ground truth as for the surfels: where the camera moves, its error is part of the
surfels' error.
The surfels of that first frame are judged.  A share of the depth is of each surfel's own true
depth.
"""

from dataclasses import dataclass, field

import numpy as np

from pliant.algorithms.arrays import F64, I64, BoolArray
from pliant.algorithms.geometry import inverse, so3_log, transform
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.evaluation.presentation import table
from pliant.evaluation.surface_truth import MaterialPoints, SurfaceTruth
from pliant.evaluation.surfel_truth import rmse, roc

INLIER = 0.01
"""A surfel is right within this share of its depth (paper, Fig. 3)."""
INLIER_PX = 1.0
"""Its own image determines no more than this of a surfel."""
_BORDER_PX = 12.0
"""Nearer to the border than half a patch no surfel can be tracked."""
_DRAGGED_PX = 3.0
_WHOLE_PX = 1e-2


@dataclass(frozen=True, kw_only=True)
class ExactRow:
    """One frame.  NaN where there is nothing to compare.

    alive, judged: surfels of the first frame that are tracked, and all of them.    followable: of
    them, those in the image and not hidden; followed: of these, the tracked ones.
    rmse_m, rmse_all_m, frozen_m: 3D, of the alive ones, of all (lost ones at their last estimate),
    of the places of birth.    rmse, rmse_all, median, in_camera: shares of the depth; ``in_camera``
    leaves out the camera's error.    right: share of the alive ones within ``INLIER``.
    dragged: alive ones that follow another sheet than their own.
    camera_m, camera, camera_rad: error of its position, also as a share of the mean depth.
    """

    frame: int
    lost: bool
    alive: int
    judged: int
    followable: int
    followed: int
    rmse_m: float
    rmse_all_m: float
    frozen_m: float
    rmse: float
    rmse_all: float
    median: float
    in_camera: float
    right: float
    dragged: int
    camera_m: float
    camera: float
    camera_rad: float


@dataclass(frozen=True)
class _Start:
    """The surfels of the first frame, and where they were born."""

    frame: int
    segment: int
    ids: I64
    points: MaterialPoints
    positions: F64  # (N, 3) world of the surfels
    T_truth_world: F64  # (4, 4) from the world of the surfels to that of ground truth
    size_m: F64  # (N,) a pixel on the surface
    others: list[F64]  # of each sheet the vertex that was nearest to each surfel, (N, 2)


@dataclass
class _Pairs:
    """Every surfel in every frame: the result of the test, and the ground truth."""

    scores: list[F64] = field(default_factory=list[F64])
    right: list[BoolArray] = field(default_factory=list[BoolArray])
    visible: list[BoolArray] = field(default_factory=list[BoolArray])
    in_place: list[BoolArray] = field(default_factory=list[BoolArray])  # within a pixel
    squares: list[F64] = field(default_factory=list[F64])  # relative errors, NaN where not alive


class ExactSurfels:
    """Takes the surfels frame by frame; ``rows`` and ``summary`` have the figures."""

    def __init__(self, truth: SurfaceTruth) -> None:
        self._truth = truth
        self._start: _Start | None = None
        self._pairs = _Pairs()
        self._dragged = np.zeros(0, np.bool_)
        self._last: F64 = np.zeros((0, 3))  # estimate of each surfel
        self.rows: list[ExactRow] = []

    def add(self, frame: int, surfels: SurfelFrame) -> None:
        """frame: of the sequence."""
        if self._start is None:
            if not len(surfels.ids):
                return
            self._start = self._begin(frame, surfels)
            self._dragged = np.zeros(len(surfels.ids), np.bool_)
            self._last = surfels.positions.copy()
        start = self._start
        row = np.minimum(np.searchsorted(surfels.ids, start.ids), max(len(surfels.ids) - 1, 0))
        listed = surfels.ids[row] == start.ids if len(surfels.ids) else row < 0
        listed &= surfels.segment == start.segment
        self._judge(frame, surfels, start, row, listed)

    def _begin(self, frame: int, surfels: SurfelFrame) -> _Start:
        truth = self._truth
        # Corners are whole pixels, and next to an edge a hair beside them is another surface.
        whole = np.rint(surfels.points_px).astype(np.float64)
        near = np.abs(whole - surfels.points_px) < _WHOLE_PX
        points = truth.at_pixels(frame, np.where(near, whole, surfels.points_px))
        there = truth.positions(points, frame)
        normals = np.cross(surfels.tangents[:, :, 0], surfels.tangents[:, :, 1])
        others = [_nearest(grid, there) for grid in truth.sheets(frame)]
        return _Start(
            frame=frame,
            segment=surfels.segment,
            ids=surfels.ids.copy(),
            points=points,
            positions=surfels.positions.copy(),
            T_truth_world=truth.T_world_camera[frame] @ inverse(surfels.T_world_camera),
            size_m=np.sqrt(np.linalg.norm(normals, axis=1)) / truth.camera.fx,
            others=others,
        )

    def _judge(
        self, frame: int, surfels: SurfelFrame, start: _Start, row: I64, listed: BoolArray
    ) -> None:
        truth = self._truth
        n = len(start.ids)
        where, alive = self._last, np.zeros(n, np.bool_)
        where[listed] = surfels.positions[row[listed]]
        alive[listed] = surfels.state[row[listed]] == SurfelState.TRACKED
        exact = transform(inverse(start.T_truth_world), truth.positions(start.points, frame))
        T_true = inverse(start.T_truth_world) @ truth.T_world_camera[frame]
        exact_camera = transform(inverse(T_true), exact)
        in_camera = transform(inverse(surfels.T_world_camera), where)
        depth = exact_camera[:, 2]
        errors = where - exact
        relative, relative_camera = (
            errors / depth[:, None],
            (in_camera - exact_camera) / depth[:, None],
        )
        amount = np.linalg.norm(relative, axis=1)
        visible = truth.visible(start.points, frame, _BORDER_PX)
        dragged = alive & self._follows_another(frame, in_camera, exact_camera, start, T_true)
        self._dragged |= dragged
        self._collect(surfels, row, listed, alive, visible, in_camera, exact_camera)
        if self.rows:
            self._pairs.squares.append(np.where(alive, amount**2, np.nan))
        off = inverse(T_true) @ surfels.T_world_camera
        camera_m = float(np.linalg.norm(off[:3, 3]))
        self.rows.append(
            ExactRow(
                frame=frame,
                lost=bool(surfels.lost),
                alive=int(alive.sum()),
                judged=n,
                followable=int(visible.sum()),
                followed=int((visible & alive).sum()),
                rmse_m=rmse(errors[alive]),
                rmse_all_m=rmse(errors),
                frozen_m=rmse(start.positions - exact),
                rmse=rmse(relative[alive]),
                rmse_all=rmse(relative),
                median=float(np.median(amount[alive])) if alive.any() else float("nan"),
                in_camera=rmse(relative_camera[alive]),
                right=float(np.mean(amount[alive] < INLIER)) if alive.any() else float("nan"),
                dragged=int(dragged.sum()),
                camera_m=camera_m,
                camera=camera_m / float(depth.mean()),
                camera_rad=float(np.linalg.norm(so3_log(off[None, :3, :3])[0])),
            )
        )

    def _follows_another(
        self, frame: int, in_camera: F64, exact_camera: F64, start: _Start, T_true: F64
    ) -> BoolArray:
        """(N,) whether a surfel is seen where another sheet has gone since its birth, not its own.

        The other sheet's hypothesis: the motion of its vertex that was nearest at birth.
        """
        truth, camera = self._truth, self._truth.camera
        T_camera_truth = inverse(start.T_truth_world @ T_true)
        born = transform(start.T_truth_world, start.positions)
        seen, own = camera.project(in_camera), camera.project(exact_camera)
        to_own = np.linalg.norm(seen - own, axis=1)
        dragged = np.zeros(len(seen), np.bool_)
        for number, vertices in enumerate(start.others):
            other = MaterialPoints(np.full(len(seen), number, np.int32), vertices)
            moved = truth.positions(other, frame) - truth.positions(other, start.frame)
            there = camera.project(transform(T_camera_truth, born + moved))
            to_other = np.linalg.norm(seen - there, axis=1)
            is_other = start.points.sheet != number
            dragged |= is_other & (to_own > _DRAGGED_PX) & (to_other < 0.5 * to_own)
        return dragged

    def _collect(
        self,
        surfels: SurfelFrame,
        row: I64,
        listed: BoolArray,
        alive: BoolArray,
        visible: BoolArray,
        in_camera: F64,
        exact_camera: F64,
    ) -> None:
        """The pairs of the ROC, in the frame of the camera: the image does not show its error.

        What was tried and not kept counts where it was tried; in recordings that do not tell, at
        its pixel and last depth.
        """
        if not self.rows:
            return  # at birth everything is right
        if len(surfels.tried) == len(surfels.ids):
            where = transform(inverse(surfels.T_world_camera), surfels.tried[row])
        else:
            tried = self._truth.camera.normalise(surfels.points_px[row])
            rays = np.concatenate([tried, np.ones((len(row), 1))], axis=1)
            where = np.where(alive[:, None], in_camera, rays * in_camera[:, 2:3])
        off = np.linalg.norm((where - exact_camera) / exact_camera[:, 2:3], axis=1)
        inside = listed & (surfels.state[row] != SurfelState.OUTSIDE)
        # Older recordings have the ZNCC alone.
        published = surfels.confidence, surfels.birth_zncc, surfels.zncc
        scores = next(each for each in published if len(each) == len(surfels.ids))
        self._pairs.scores.append(scores[row][inside].astype(np.float64))
        self._pairs.right.append((off < INLIER)[inside])
        self._pairs.visible.append(visible[inside])
        front = (where[:, 2] > 0.0) & (exact_camera[:, 2] > 0.0)
        seen, own = (
            self._truth.camera.project(np.where(front[:, None], points, 1.0))
            for points in (where, exact_camera)
        )
        near = front & (np.linalg.norm(seen - own, axis=1) < INLIER_PX)
        self._pairs.in_place.append(near[inside])

    def curve(self, *, visible: bool = False) -> tuple[F64, F64, float]:
        """ROC of the confidence: false and true positive rates, AUC.  visible: of those alone."""
        pairs = self._pairs
        if not pairs.scores:
            return roc(np.zeros(0), np.zeros(0, np.bool_))
        scores, right = np.concatenate(pairs.scores), np.concatenate(pairs.right)
        kept = np.concatenate(pairs.visible) if visible else np.ones(len(scores), np.bool_)
        return roc(scores[kept], right[kept])

    def curve_in_image(self) -> tuple[F64, F64, float]:
        """The same for surfels that are within ``INLIER_PX`` of where their own point is seen."""
        pairs = self._pairs
        if not pairs.scores:
            return roc(np.zeros(0), np.zeros(0, np.bool_))
        return roc(np.concatenate(pairs.scores), np.concatenate(pairs.in_place))

    def by_size(self, parts: int = 3) -> list[tuple[float, float, float]]:
        """(least, most mm a pixel on the surface at birth, RMSE by depth) of equal parts."""
        assert self._start is not None
        if not self._pairs.squares:
            return []
        squares = np.array(self._pairs.squares)
        out: list[tuple[float, float, float]] = []
        for rows in np.array_split(np.argsort(self._start.size_m, kind="stable"), parts):
            if len(rows):
                sizes = 1e3 * self._start.size_m[rows]
                out.append((float(sizes[0]), float(sizes[-1]), _root_mean(squares[:, rows])))
        return out

    def by_sheet(self) -> dict[str, tuple[int, float]]:
        """For each sheet, the number of its surfels and their relative RMSE while alive."""
        assert self._start is not None
        if not self._pairs.squares:
            return {}
        squares = np.array(self._pairs.squares)
        out: dict[str, tuple[int, float]] = {}
        for number, name in enumerate(self._truth.names):
            mine = self._start.points.sheet == number
            if mine.any():
                out[name] = (int(mine.sum()), _root_mean(squares[:, mine]))
        return out

    def summary(self) -> dict[str, float]:
        """Means over the frames after the first, and what is of the whole run.

        Beside the columns: ``whole`` (RMSE by depth over all frames and alive surfels together),
        ``alive_last`` and ``followed_last`` (shares, last frame), ``frames_until_loss``,
        ``dragged_ever``, ``camera_rmse`` (by depth) and ``auc``, ``auc_visible``, ``auc_image``.
        """
        after = self.rows[1:]
        names = [name for name in ExactRow.__dataclass_fields__ if name not in ("frame", "lost")]
        out = {name: _mean([float(getattr(row, name)) for row in after]) for name in names}
        last = self.rows[-1]
        lost = [k for k, row in enumerate(self.rows) if row.lost]
        squares = np.array(self._pairs.squares) if self._pairs.squares else np.zeros((0, 1))
        camera = np.array([row.camera for row in after if not row.lost])
        out |= {
            "whole": _root_mean(squares),
            "alive_share": out["alive"] / max(1.0, out["judged"]),
            "alive_last": last.alive / max(1, last.judged),
            "followed_last": last.followed / max(1, last.followable),
            "frames_until_loss": float(lost[0] if lost else len(self.rows)),
            "dragged_ever": float(self._dragged.sum()),
            "camera_rmse": float(np.sqrt(np.mean(camera**2))) if len(camera) else float("nan"),
            "auc": self.curve()[2],
            "auc_visible": self.curve(visible=True)[2],
            "auc_image": self.curve_in_image()[2],
        }
        return out


def _nearest(grid: F64, points: F64) -> F64:
    """(N, 2) column and row of the vertex of a (R, C, 3) grid that is nearest to (N, 3) points."""
    columns = grid.shape[1]
    flat = grid.reshape(-1, 3)
    known = np.where(np.isfinite(points), points, 0.0)
    square = (flat**2).sum(axis=1) - 2.0 * known @ flat.T
    index = np.argmin(square, axis=1)
    return np.stack([index % columns, index // columns], axis=1).astype(np.float64)


def _mean(values: list[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


def _root_mean(squares: F64) -> float:
    known = squares[np.isfinite(squares)]
    return float(np.sqrt(known.mean())) if len(known) else float("nan")


def format_exact(surfels: ExactSurfels, *, moving_camera: bool) -> str:
    """A table of some frames and the mean, and what is of the whole run."""
    heading = ["frame", "alive", "in view", "RMSE mm", "all mm", "frozen mm", "RMSE %", "all %"]
    heading += ["median %", "< 1 %", *(["in camera %", "camera %"] if moving_camera else [])]
    lines = [tuple(heading)]
    rows = surfels.rows
    for number in sorted({0, *np.linspace(0, len(rows) - 1, 7).astype(int).tolist()}):
        row = rows[number]
        counts = (str(row.frame), f"{row.alive}/{row.judged}", f"{row.followed}/{row.followable}")
        lines.append((*counts, *_figures(row.__dict__, moving_camera)))
    mean = surfels.summary()
    counts = ("mean 1-", f"{mean['alive_share']:.1%}", f"{mean['followed']:.0f}")
    lines.append((*counts, *_figures(mean, moving_camera)))
    text = [
        "surfels compared with exact ground truth, untrimmed, no alignment; % of the depth",
        table(lines),
    ]
    text.append(
        f"whole run: RMSE {mean['whole']:.2%}, alive in the last frame {mean['alive_last']:.1%} "
        f"(of those in view {mean['followed_last']:.1%}), frames until loss "
        f"{mean['frames_until_loss']:.0f}, dragged by another sheet {mean['dragged_ever']:.0f}"
    )
    text.append(
        f"confidence as a test of 3D errors below 1 % of the depth: AUC {mean['auc']:.3f}, of "
        f"those in view {mean['auc_visible']:.3f}; of being within 1 px in the image: "
        f"{mean['auc_image']:.3f}"
    )
    sheets = surfels.by_sheet().items()
    if len(sheets) > 1:
        parts = (f"{name} {error:.2%} ({count})" for name, (count, error) in sheets)
        text.append("RMSE of each surface: " + ", ".join(parts))
    parts = (f"{low:.2f}-{high:.2f}: {error:.2%}" for low, high, error in surfels.by_size())
    text.append("RMSE by size, mm of surface a pixel: " + ", ".join(parts))
    if moving_camera:
        text.append(
            f"camera: RMSE of its position {mean['camera_rmse']:.2%} of the depth, mean error "
            f"{1e3 * mean['camera_m']:.2f} mm and {np.degrees(mean['camera_rad']):.2f} deg"
        )
    return "\n".join(text)


def _figures(row: dict[str, float], moving_camera: bool) -> list[str]:
    lengths = [f"{1e3 * row[name]:.2f}" for name in ("rmse_m", "rmse_all_m", "frozen_m")]
    shares = ["rmse", "rmse_all", "median", "right"]
    shares += ["in_camera", "camera"] if moving_camera else []
    return [*lengths, *(f"{100.0 * row[name]:.{1 if name == 'right' else 2}f}" for name in shares)]
