"""Direct and sparse deformable tracking (DSDT, Lamarca et al. 2022).

From frame to frame surfels are followed (``frame_tracker.py``).  Here they are born, and segments
are left and resumed: after a loss the camera may see the surfels of an earlier one again.
"""

import numpy as np

from pliant.algorithms.arrays import F64, I64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.slam.places.place_index import Features, describe
from pliant.algorithms.stages import StageTimer, no_stages
from pliant.algorithms.surfels import validation
from pliant.algorithms.surfels.births import find_births
from pliant.algorithms.surfels.brightness import exposure
from pliant.algorithms.surfels.depth_maps import contradicted_by_depth, depth_between
from pliant.algorithms.surfels.frame_tracker import FrameTracker, Segment
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.patch_sampling import Level, X
from pliant.algorithms.surfels.remembered_views import FoundBack, RememberedViews
from pliant.algorithms.surfels.surfel_frame import SurfelFrame
from pliant.algorithms.surfels.surfel_table import SurfelTable, frame_of

_KEPT = 0.7
"""Minimum share of the previous frame's tracked surfels; below it, views are searched."""
_FOUND_BACK = 0.5
"""Minimum share of the surfels with agreeing corners that are then tracked."""
_BY_CHANCE = 0.2
"""After a loss fewer than this share of the surfels may be tracked in another scene by chance."""
_EARLIER = 2
"""Number of stored earlier segments that may resume: some 15 MB each."""


class SurfelTracker:
    """Tracks independently moving surfels, from a depth map on.

    Deterministic: the output depends only on images, depths and parameters.
    """

    def __init__(self, parameters: SurfelParameters) -> None:
        self._parameters = parameters
        self._frames = FrameTracker(parameters)
        self._camera: PinholeCamera | None = None
        self._now = Segment()
        self._frame, self._segments, self._next_id = 0, 0, 0
        self._lost_for_s = 0.0
        self._views = RememberedViews()
        self._earlier: dict[int, SurfelTable] = {}

    def start(
        self, image: U8, depth: F64, camera: PinholeCamera, T_world_camera: F64 | None = None
    ) -> SurfelFrame:
        """Create surfels (section III).

        image: (H, W) uint8.  depth: (H, W) metres, 0 or NaN for holes.  T_world_camera: (4, 4), by
        default the camera's frame is the world.  Raises ValueError for arrays of another size.
        """
        self._camera, self._now = camera, Segment()
        if T_world_camera is not None:
            self._now.T_world_camera = T_world_camera.copy()
        self._frame, self._segments, self._next_id = 0, 0, 0
        self._lost_for_s = 0.0
        self._views, self._earlier = RememberedViews(), {}
        pyramid = self._frames.pyramid(image, camera)
        self._give_birth(pyramid, _checked_depth(depth, camera))
        self._remember(image)
        return self._result()

    def track(
        self,
        image: U8,
        interval_s: float,
        prediction: F64 | None = None,
        depth: F64 | None = None,
        timer: StageTimer = no_stages,
    ) -> SurfelFrame:
        """Track all surfels into the next frame.

        image: (H, W) uint8.  interval_s: since the last frame, seconds.  prediction: (N, 2)
        displacements in pixels from the last frame, in the order of the last result, NaN where
        there is none.  depth: (H, W) metres of this frame, for new surfels in free areas.  timer:
        called at each stage.  Raises ValueError before ``start``, and for arrays of another size.
        """
        if self._camera is None:
            raise ValueError("track() before start(): surfels need a depth map to begin with")
        with timer("pyramid"):
            pyramid = self._frames.pyramid(image, self._camera)
        before, was_lost = self._now.table.copy(), self._now.lost
        self._frames.follow(self._now, pyramid, prediction, interval_s, timer)
        self._frame += 1
        with timer("views"):
            seen = self._look_back(image, pyramid, before, interval_s, was_lost=was_lost)
        with timer("templates"):
            if not self._now.lost and len(self._now.table):
                self._frames.update_templates(self._now, pyramid, self._frame)
        self._since_birth_s += interval_s
        self._count_lost_seconds(interval_s)
        self._compare(depth)
        if self._parameters.depth_from == "flat":
            depth = self._made_up_depth()
        if depth is not None:
            with timer("births"):
                self._give_birth(pyramid, _checked_depth(depth, self._camera))
        self._remember(image, seen)
        return self._result()

    def add(self, image: U8, depth: F64, T_world_camera: F64 | None = None) -> SurfelFrame:
        """Create more surfels in free areas of the last tracked frame.

        image: (H, W) uint8 of that frame.  depth: (H, W) in units of the surfels.  T_world_camera:
        (4, 4), the camera's pose if tracking is lost: surfels start again from there.  Raises
        ValueError before ``start``, and for arrays of another size.
        """
        if self._camera is None:
            raise ValueError("add() before start(): surfels need a depth map to begin with")
        if self._now.lost and T_world_camera is not None:
            self._now.T_world_camera = T_world_camera.copy()
        pyramid = self._frames.pyramid(image, self._camera)
        self._give_birth(pyramid, _checked_depth(depth, self._camera))
        self._remember(image)
        return self._result()

    def place(self, T_world_camera: F64) -> SurfelFrame:
        """Correct the camera's pose (4, 4): the world moves with it, and no pixel changes."""
        self._now.table.move(T_world_camera @ inverse(self._now.T_world_camera))
        self._now.T_world_camera = T_world_camera.copy()
        return self._result()

    def settle(self, rows: I64, rest: F64, sigmas: F64) -> None:
        """Change where rows of the last result rest (R, 3), world, and by how much they move from
        there (R,): Eq. 20.
        """
        self._now.table.settle(rows, rest, sigmas)

    def _look_back(
        self,
        image: U8,
        pyramid: list[Level],
        before: SurfelTable,
        interval_s: float,
        *,
        was_lost: bool,
    ) -> Features | None:
        """Resume at a recognised view.  Returns the corners of the image if it was searched.

        before: the surfels in the last frame.  If many of them were lost, they are searched by the
        index as well; those of older segments whenever the view is another.
        """
        now, camera, followed = self._now, self._camera, int(self._now.table.tracked.sum())
        assert camera is not None
        lost = now.lost or was_lost or followed < _KEPT * int(before.tracked.sum())
        if not lost and not self._views.is_another(now.table, camera):
            return None
        seen = describe(image)
        older = {n: table for n, table in self._earlier.items() if n < now.number}
        tables = {**self._earlier, now.number: before} if lost else older
        still = None if self._parameters.camera == "moving" else now.T_world_camera
        found = self._views.recognise(seen, tables, still, camera)
        if found is not None:
            self._go_on(found, tables[found.segment], pyramid, interval_s)
        return seen

    def _go_on(
        self, found: FoundBack, table: SurfelTable, pyramid: list[Level], interval_s: float
    ) -> None:
        """Track surfels from their proposed positions.  Nothing changes unless they are found
        there, more of them than without the proposal, and not too few compared with this segment.
        """
        now, table = self._now, table.copy()
        table.guesses = found.poses
        proposed = Segment(number=found.segment, table=table, T_world_camera=found.T_world_camera)
        self._frames.follow(proposed, pyramid, None, interval_s, no_stages)
        there, another = table.tracked, found.segment != now.number
        least = (_FOUND_BACK if another else 1.0) * now.table.tracked.sum()
        if proposed.lost or there[found.rows].mean() < _FOUND_BACK or there.sum() <= least:
            return
        self._now = proposed
        if another:
            self._earlier.pop(found.segment)
            self._leave(now)

    def _leave(self, segment: Segment) -> None:
        """Store the surfels of a segment that is left, as long as there is memory."""
        self._earlier[segment.number] = segment.table
        for old in list(self._earlier)[:-_EARLIER]:
            del self._earlier[old]
            self._views.forget_segment(old)

    def _remember(self, image: U8, seen: Features | None = None) -> None:
        """Store this view if it is another one.  seen: its corners, if known."""
        now, camera = self._now, self._camera
        assert camera is not None
        if not now.lost and self._views.is_another(now.table, camera):
            self._views.remember(
                seen or describe(image), now.table, now.number, now.T_world_camera, camera,
                self._parameters.patch_px,
            )  # fmt: skip

    def _compare(self, depth: F64 | None) -> None:
        """Mark the tracked surfels that a measured depth contradicts."""
        table = self._now.table
        table.contradicted = np.zeros(len(table), np.bool_)
        if depth is not None and self._parameters.depth_from == "sensor":
            points = table.validations[:, validation.U : validation.V + 1]
            off, _ = contradicted_by_depth(depth, points, self._now.in_camera()[:, X + 2])
            table.contradicted = off & table.tracked

    def _count_lost_seconds(self, interval_s: float) -> None:
        followed = int(self._now.table.tracked.sum())
        by_chance = self._lost_for_s > 0.0 and followed < _BY_CHANCE * self._followed
        if self._now.lost or by_chance:
            self._lost_for_s += interval_s
        else:
            self._lost_for_s, self._followed = 0.0, followed

    def _made_up_depth(self) -> F64 | None:
        """Depth for births on ``flat``, as often as places become free: that of confirmed surfels,
        as others may have drifted along their rays.

        A scene that is missing for a single frame, covered or blurred, is no other scene.
        """
        now, p, camera = self._now, self._parameters, self._camera
        assert camera is not None
        gone = now.lost or self._lost_for_s > 0.0
        if self._since_birth_s < p.lost_after_s or (gone and self._lost_for_s < p.lost_after_s):
            return None
        if gone:
            now.lost = True
            return np.ones((camera.height, camera.width))
        table = now.table
        points = table.validations[table.confirmed, validation.U : validation.V + 1]
        there = transform(inverse(now.T_world_camera), table.poses[table.confirmed, X : X + 3])
        return depth_between(points, there[:, 2], camera)

    def _give_birth(self, pyramid: list[Level], depth: F64) -> None:
        now, p, camera = self._now, self._parameters, self._camera
        assert camera is not None
        table = now.table
        self._since_birth_s = 0.0
        anew = now.lost and len(table) > 0
        if not now.lost:
            table.keep(np.flatnonzero(table.missing <= p.lost_after_s + p.forget_after_s))
        alive = np.flatnonzero(table.tracked & (not anew))
        occupied = table.validations[alive, validation.U : validation.V + 1]
        # On made-up depth only surface without surfels needs some.  They may be on a tool, and
        # must not pull what is tracked along.
        flat = p.depth_from == "flat"
        births = find_births(
            pyramid, depth, camera, p, occupied, p.max_surfels - len(alive),
            p.patch_px if flat else p.spacing_px,
        )  # fmt: skip
        n = len(births.poses)
        if anew and n < p.min_alive:
            return  # in the dark nothing can start: the tracked surfels are still searched
        if anew:
            self._leave(now)
            self._segments += 1
            now = self._now = Segment(number=self._segments, T_world_camera=now.T_world_camera)
            table = now.table
        if flat:  # the longest missing ones make room
            newest = np.argsort(table.missing, kind="stable")[: p.max_surfels - n]
            table.keep(np.sort(newest))
        # The heuristic covariance of section V: a share of the surfel's depth, all directions.
        sigmas = np.maximum(p.expected_motion * births.poses[:, X + 2], 1e-9)
        table.add(births, now.T_world_camera, self._next_id, self._frame, sigmas, self._exposure())
        # A map errs in the depth of all new surfels, which the whole surface averages.
        widely = p.depth_from == "map"
        table.connect(len(table) - n, p.neighbours, with_earlier=not flat, widely=widely)
        self._next_id += n
        self._followed = int(table.tracked.sum())
        now.lost = self._followed < p.min_alive
        self._frames.measure(now, pyramid[0], np.flatnonzero(table.born == self._frame))

    def _exposure(self) -> float:
        """Of the last frame relative to the first of this segment, where brightness counts."""
        table = self._now.table
        if self._parameters.light != "camera" or not table.tracked.any():
            return 1.0
        means = table.templates[0].means
        return exposure(self._now.in_camera(), table.brightness, means, table.tracked)

    def _result(self) -> SurfelFrame:
        return frame_of(
            self._now.table, frame=self._frame, segment=self._now.number, lost=self._now.lost,
            T_world_camera=self._now.T_world_camera,
            depth_is_known=self._parameters.depth_from != "flat",
        )  # fmt: skip


def _checked_depth(depth: F64, camera: PinholeCamera) -> F64:
    if depth.shape != (camera.height, camera.width):
        raise ValueError(
            f"expected depth of shape {(camera.height, camera.width)}, got {depth.shape}"
        )
    depth = np.ascontiguousarray(depth, np.float64)
    return np.where(np.isfinite(depth) & (depth > 0.0), depth, 0.0)
