"""Direct and sparse deformable tracking (DSDT, Lamarca et al. 2022)."""

import numpy as np

from pliant.algorithms.arrays import F64, I64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.slam.places.place_index import Features, describe
from pliant.algorithms.stages import StageTimer, no_stages
from pliant.algorithms.surfels import validation
from pliant.algorithms.surfels.births import find_births
from pliant.algorithms.surfels.brightness import exposure
from pliant.algorithms.surfels.camera_alignment import align_rigid, fit_camera, spread
from pliant.algorithms.surfels.deformation_models import MODELS, move_poses
from pliant.algorithms.surfels.depth_maps import depth_between
from pliant.algorithms.surfels.graph_alignment import COARSE_STEPS, STEPS, align_graph, relocate
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.patch_sampling import (
    Level,
    X,
    make_pyramid,
    usable_levels,
)
from pliant.algorithms.surfels.prediction import start_at, targets
from pliant.algorithms.surfels.remembered_views import FoundBack, RememberedViews
from pliant.algorithms.surfels.surfel_alignment import (
    OMEGA_E,
    Equilibrium,
    Limits,
    Matcher,
    Workspace,
    align_all,
    evaluate_all,
    make_workspace,
    no_equilibrium,
)
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.algorithms.surfels.surfel_table import SurfelTable, frame_of
from pliant.algorithms.surfels.template_update import RELOCATED_ZNCC, TemplateUpdate

_TOGETHER_LEVELS, _FEWER_TOGETHER = 2, 1
"""Levels, the finest, at which surfels with neighbours move as one.  Fewer before a moving camera,
where more take twice as long and the camera is hardly better, and on made-up depth, whose shape is
wrong: at half the size it would lead to where the image does not fit."""
_KEPT = 0.7
"""Minimum share of the previous frame's tracked surfels; below it, views are searched."""
_FOUND_BACK = 0.5
"""Minimum share of the surfels with agreeing corners that are then tracked."""
_BY_CHANCE = 0.2
"""After a loss fewer than this share of the surfels may be tracked in another scene by chance."""
_EARLIER = 2
"""Number of stored earlier segments that may resume: some 15 MB each."""
_BLEND, _COARSE_STATIC_BLEND = 1.0, 0.5
"""Share of the frame in the derivatives of a patch; the rest is the texture's.  At the coarse
scales of a static camera their mean converges most often (second order, as in ESM); before a moving
one it finds fewer surfels again after a jump."""
_ITERATIONS, _COARSE_ITERATIONS = 10, 6
_STRAIN_SIGMA = 0.01
"""Of the soft isometry with a lamp at the camera."""
_STEP_PX, _COARSE_STEP_PX = 0.01, 0.05


class SurfelTracker:
    """Tracks independently moving surfels, from a depth map on.

    Deterministic: the output depends only on images, depths and parameters.
    """

    def __init__(self, parameters: SurfelParameters) -> None:
        self._parameters = parameters
        self._works: list[Workspace] = []
        self._table = SurfelTable()
        self._camera: PinholeCamera | None = None
        self._T_world_camera: F64 = np.eye(4)
        self._frame, self._segment, self._segments, self._next_id = 0, 0, 0, 0
        self._interval_s, self._lost = 0.0, True
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
        self._camera = camera
        self._table, self._frame, self._next_id = SurfelTable(), 0, 0
        self._segment = self._segments = 0
        self._lost_for_s = 0.0
        self._views, self._earlier = RememberedViews(), {}
        self._T_world_camera = np.eye(4) if T_world_camera is None else T_world_camera.copy()
        pyramid = self._pyramid(image)
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
            pyramid = self._pyramid(image)
        goals = self._goals(prediction, len(pyramid))
        self._frame, self._interval_s = self._frame + 1, interval_s
        before, was_lost = self._table.copy(), self._lost
        self._follow(pyramid, goals, timer)
        with timer("views"):
            seen = self._look_back(image, pyramid, before, was_lost=was_lost)
        with timer("templates"):
            self._update_templates(pyramid)
        self._since_birth_s += interval_s
        self._count_lost_seconds()
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
        if self._lost and T_world_camera is not None:
            self._T_world_camera = T_world_camera.copy()
        self._give_birth(self._pyramid(image), _checked_depth(depth, self._camera))
        self._remember(image)
        return self._result()

    def place(self, T_world_camera: F64) -> SurfelFrame:
        """Correct the camera's pose (4, 4): the world moves with it, and no pixel changes."""
        self._table.move(T_world_camera @ inverse(self._T_world_camera))
        self._T_world_camera = T_world_camera.copy()
        return self._result()

    def settle(self, rows: I64, rest: F64, sigmas: F64) -> None:
        """Change where rows of the last result rest (R, 3), world, and by how much they move from
        there (R,): Eq. 20.
        """
        self._table.settle(rows, rest, sigmas)

    def _pyramid(self, image: U8) -> list[Level]:
        camera, p = self._camera, self._parameters
        assert camera is not None
        if image.shape != (camera.height, camera.width) or image.dtype != np.uint8:
            raise ValueError(
                f"expected a uint8 image of shape {(camera.height, camera.width)}, "
                f"got {image.dtype} {image.shape}"
            )
        levels = usable_levels(camera.width, camera.height, p.patch_px, p.levels)
        pyramid = make_pyramid(image, camera, levels, p.patch_px)
        if len(self._works) != len(pyramid):
            self._works = [make_workspace(level.side) for level in pyramid]
        return pyramid

    def _goals(self, prediction: F64 | None, levels: int) -> F64 | None:
        """Predicted pixels at the coarsest level."""
        if prediction is None:
            return None
        if prediction.shape != (len(self._table), 2):
            raise ValueError(
                f"expected a prediction of shape {(len(self._table), 2)}, got {prediction.shape}"
            )
        points = self._table.validations[:, validation.U : validation.V + 1]
        return targets(points, prediction, float(2 ** (levels - 1)))

    def _look_back(
        self, image: U8, pyramid: list[Level], before: SurfelTable, *, was_lost: bool
    ) -> Features | None:
        """Resume at a recognised view.  Returns the corners of the image if it was searched.

        before: the surfels in the last frame.  If many of them were lost, they are searched by the
        index as well; those of older segments whenever the view is another.
        """
        camera, followed = self._camera, int(self._table.tracked.sum())
        assert camera is not None
        lost = self._lost or was_lost or followed < _KEPT * int(before.tracked.sum())
        if not lost and not self._views.is_another(self._table, camera):
            return None
        seen = describe(image)
        older = {n: table for n, table in self._earlier.items() if n < self._segment}
        tables = {**self._earlier, self._segment: before} if lost else older
        still = None if self._parameters.camera == "moving" else self._T_world_camera
        found = self._views.recognise(seen, tables, still, camera)
        if found is not None:
            self._go_on(found, tables, pyramid)
        return seen

    def _count_lost_seconds(self) -> None:
        followed = int(self._table.tracked.sum())
        by_chance = self._lost_for_s > 0.0 and followed < _BY_CHANCE * self._followed
        if self._lost or by_chance:
            self._lost_for_s += self._interval_s
        else:
            self._lost_for_s, self._followed = 0.0, followed

    def _made_up_depth(self) -> F64 | None:
        """Depth for births on ``flat``, as often as places become free: that of confirmed surfels,
        as others may have drifted along their rays.

        A scene that is missing for a single frame, covered or blurred, is no other scene.
        """
        table, p, camera = self._table, self._parameters, self._camera
        assert camera is not None
        gone = self._lost or self._lost_for_s > 0.0
        if self._since_birth_s < p.lost_after_s or (gone and self._lost_for_s < p.lost_after_s):
            return None
        if gone:
            self._lost = True
            return np.ones((camera.height, camera.width))
        points = table.validations[table.confirmed, validation.U : validation.V + 1]
        there = transform(inverse(self._T_world_camera), table.poses[table.confirmed, X : X + 3])
        return depth_between(points, there[:, 2], camera)

    def _remember(self, image: U8, seen: Features | None = None) -> None:
        """Store this view if it is another one.  seen: its corners, if known."""
        camera, patch_px = self._camera, self._parameters.patch_px
        assert camera is not None
        if not self._lost and self._views.is_another(self._table, camera):
            seen = seen or describe(image)
            self._views.remember(
                seen, self._table, self._segment, self._T_world_camera, camera, patch_px
            )

    def _go_on(
        self, found: FoundBack, tables: dict[int, SurfelTable], pyramid: list[Level]
    ) -> None:
        """Track surfels from their proposed positions.  Nothing changes unless they are found
        there, more of them than without the proposal, and not too few compared with this segment.
        """
        now = self._table, self._T_world_camera, self._segment, self._lost
        self._table, self._segment = tables[found.segment].copy(), found.segment
        self._table.guesses, self._T_world_camera = found.poses, found.T_world_camera
        self._follow(pyramid, None, no_stages)
        there, followed = self._table.tracked, now[0].tracked
        another = found.segment != now[2]
        if (
            self._lost
            or there[found.rows].mean() < _FOUND_BACK
            or there.sum() <= (_FOUND_BACK if another else 1.0) * followed.sum()
        ):
            self._table, self._T_world_camera, self._segment, self._lost = now
        elif another:
            self._earlier.pop(found.segment)
            self._leave(now[0], now[2])

    def _leave(self, table: SurfelTable, segment: int) -> None:
        """Store the surfels of a segment that is left, as long as there is memory."""
        self._earlier[segment] = table
        for old in list(self._earlier)[:-_EARLIER]:
            del self._earlier[old]
            self._views.forget_segment(old)

    def _follow(self, pyramid: list[Level], goals: F64 | None, timer: StageTimer) -> None:
        poses = move_poses(self._table.guesses, inverse(self._T_world_camera))
        torn = self._align(pyramid, poses, goals, timer)
        with timer("validation"):
            self._validate(pyramid[0], poses, torn)

    def _align(
        self, pyramid: list[Level], poses: F64, goals: F64 | None, timer: StageTimer
    ) -> BoolArray:
        """Coarse to fine: the solution of a scale initialises the next (section VI-A2).

        A moving camera is first estimated as if the scene were rigid.  Then camera and surfels
        alternate: surfels with a fixed camera, then the camera that fits them.  The image
        determines a surfel's position far more than its equilibrium, so one alternation per level
        is sufficient.  Returns which surfels have left their neighbours.
        """
        table, moving, n = self._table, self._parameters.camera == "moving", len(poses)
        everyone, torn, coarsest = np.ones(n, np.uint8), np.zeros(n, np.bool_), len(pyramid) - 1
        # Missing surfels are searched too, but do not determine the camera.
        guides = table.tracked.astype(np.uint8)
        if not moving or int(guides.sum()) < self._parameters.min_alive:
            guides = everyone
        T_camera_world, equilibrium = inverse(self._T_world_camera), no_equilibrium(n)
        start, weights = poses, OMEGA_E / table.sigmas**2
        made_up = self._parameters.depth_from == "flat"
        together = _FEWER_TOGETHER if moving or made_up else _TOGETHER_LEVELS
        together = together if len(table.edges.ends) else 0
        for number in range(coarsest, -1, -1):
            level = pyramid[number]
            if number == coarsest:
                if moving:
                    T_camera_world = self._align_rigid(level, poses, guides, T_camera_world, timer)
                self._start_at(goals, level, poses, guides)
                start = poses.copy()
            if moving:
                equilibrium = Equilibrium(transform(T_camera_world, table.rest), weights)
                start = move_poses(table.guesses, T_camera_world)
            if not moving and made_up and number == together - 1:
                self._stay_where_it_fits(number, level, start, poses)
            # Alone each surfel finds its pixel; close to it its depth would drift.
            if number == coarsest or number >= together:
                self._align_alone(number, level, poses, everyone, equilibrium, timer)
            if number < together:
                torn = self._align_graph(number, level, poses, start, everyone, equilibrium, timer)
            if moving:
                with timer("camera"):
                    T_camera_world = fit_camera(
                        poses, guides, T_camera_world, table.rest, weights, across=table.settled
                    )
        if moving:
            self._T_world_camera = inverse(T_camera_world)
        return torn

    def _stay_where_it_fits(self, number: int, level: Level, start: F64, poses: F64) -> None:
        """Undo the coarse scales where they do not raise the ZNCC.

        A patch of a coarse scale covers more of the scene: what deforms, or an instrument, moves
        it.  Near by, the fine scales then end in another minimum.  With a measured depth it gains
        nothing.  start: poses before the coarse scales.  poses: after them, overwritten.
        """
        everyone, matcher = np.ones(len(poses), np.uint8), self._matcher(number, level)
        before = evaluate_all(start, everyone, matcher, zncc=True)
        after = evaluate_all(poses, everyone, matcher, zncc=True)
        stay = before.zncc >= after.zncc
        poses[stay] = start[stay]

    def _start_at(self, goals: F64 | None, level: Level, poses: F64, active: U8) -> None:
        if goals is not None and self._table.templates:
            start_at(poses, active, goals, self._matcher(-1, level))

    def _align_rigid(
        self, level: Level, poses: F64, guides: U8, T_camera_world: F64, timer: StageTimer
    ) -> F64:
        matcher = self._matcher(-1, level)
        some = spread(guides * matcher.templates.usable)
        with timer("camera alone"):
            return align_rigid(poses, some, T_camera_world, matcher)

    def _align_alone(
        self,
        number: int,
        level: Level,
        poses: F64,
        active: U8,
        equilibrium: Equilibrium,
        timer: StageTimer,
    ) -> None:
        with timer(f"alone, level {number}"):
            align_all(poses, active, equilibrium, self._matcher(number, level))

    def _align_graph(
        self,
        number: int,
        level: Level,
        poses: F64,
        start: F64,
        active: U8,
        equilibrium: Equilibrium,
        timer: StageTimer,
    ) -> BoolArray:
        with timer(f"together, level {number}"):
            return align_graph(
                poses, start, active, self._table.edges, equilibrium, self._matcher(number, level),
                self._parameters, STEPS if number == 0 else COARSE_STEPS,
                None if self._parameters.light == "any" else self._table.brightness,
            )  # fmt: skip

    def _validate(self, level: Level, poses: F64, torn: BoolArray) -> None:
        """Keep the tracked surfels; the others keep their last good estimate."""
        table, p = self._table, self._parameters
        found, matcher = table.validations, self._matcher(0, level)
        validation.validate_all(poses, np.ones(len(poses), np.uint8), matcher, found)
        if len(table.edges.ends):
            unlike = (found[:, validation.ZNCC] < p.min_zncc) & (found[:, validation.FRONT] > 0.0)
            passed = (unlike | torn) & (found[:, validation.INSIDE] >= p.min_visible)
            rows = passed.astype(np.uint8)
            relocate(poses, rows, table.edges, matcher, p.strain)
            validation.validate_all(poses, rows, matcher, found)
            torn = torn & ~passed
        wanted = np.where(table.missing > 0, max(p.min_zncc, RELOCATED_ZNCC), p.min_zncc)
        state = np.full(len(table), SurfelState.TRACKED, np.uint8)
        state[found[:, validation.ZNCC] < wanted] = SurfelState.OUTLIER
        state[found[:, validation.VISIBLE] < p.min_visible] = SurfelState.OCCLUDED
        state[found[:, validation.INSIDE] < p.min_visible] = SurfelState.OUTSIDE
        state[found[:, validation.FRONT] == 0.0] = SurfelState.OUTSIDE
        state[torn & (state == SurfelState.TRACKED)] = SurfelState.OUTLIER
        good = (state == SurfelState.TRACKED) & np.isfinite(poses).all(axis=1)
        table.missing = np.where(good, 0.0, table.missing + self._interval_s)
        state[~good & (table.missing > p.lost_after_s)] = SurfelState.LOST
        table.state = state
        self._lost = int(good.sum()) < p.min_alive
        if self._lost:  # surfels are never dropped in the dark
            table.missing = np.minimum(table.missing, p.lost_after_s)
        world = move_poses(poses, self._T_world_camera)
        finite = np.isfinite(world).all(axis=1, keepdims=True)
        table.tried = np.where(finite, world[:, X : X + 3], table.poses[:, X : X + 3])
        table.poses[good] = world[good]
        # With neighbours, invisible surfels are searched at their position.
        table.guesses = table.poses.copy()
        if p.neighbours and not self._lost:
            carried = ~good & np.isfinite(world).all(axis=1)
            table.guesses[carried] = world[carried]

    def _give_birth(self, pyramid: list[Level], depth: F64) -> None:
        table, p, camera = self._table, self._parameters, self._camera
        assert camera is not None
        self._since_birth_s = 0.0
        anew = self._lost and len(table) > 0
        if not self._lost:
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
            self._leave(table, self._segment)
            self._table = table = SurfelTable()
            self._segment = self._segments = self._segments + 1
        if flat:  # the longest missing ones make room
            newest = np.argsort(table.missing, kind="stable")[: p.max_surfels - n]
            table.keep(np.sort(newest))
        # The heuristic covariance of section V: a share of the surfel's depth, all directions.
        sigmas = np.maximum(p.expected_motion * births.poses[:, X + 2], 1e-9)
        table.add(
            births, self._T_world_camera, self._next_id, self._frame, sigmas, self._exposure()
        )
        table.connect(len(table) - n, p.neighbours, with_earlier=not flat)
        self._next_id += n
        self._followed = int(table.tracked.sum())
        self._lost = self._followed < p.min_alive
        rows = (table.born == self._frame).astype(np.uint8)
        poses = move_poses(table.poses, inverse(self._T_world_camera))
        validation.validate_all(poses, rows, self._matcher(0, pyramid[0]), table.validations)

    def _exposure(self) -> float:
        """Of the last frame relative to the first of this segment, where brightness counts."""
        table = self._table
        if self._parameters.light != "camera" or not table.tracked.any():
            return 1.0
        poses = move_poses(table.poses, inverse(self._T_world_camera))
        return exposure(poses, table.brightness, table.templates[0].means, table.tracked)

    def _update_templates(self, pyramid: list[Level]) -> None:
        if self._lost or not len(self._table):
            return
        matchers = [
            self._matcher(number, level)._replace(templates=self._table.birth[number])
            for number, level in enumerate(pyramid)
        ]
        TemplateUpdate(self._table, self._parameters, pyramid, matchers, self._T_world_camera).run(
            self._frame
        )

    def _matcher(self, number: int, level: Level) -> Matcher:
        """number: of the level, 0 being that of full size, -1 the coarsest."""
        return Matcher(
            level, self._table.templates[number], self._limits(fine=number == 0),
            self._works[number],
        )  # fmt: skip

    def _limits(self, *, fine: bool) -> Limits:
        p = self._parameters
        coarse_static, by_light = not fine and p.camera == "static", p.light != "any"
        return Limits(
            MODELS["general" if by_light else p.model],
            _COARSE_STATIC_BLEND if coarse_static else _BLEND,
            p.highlight,
            _ITERATIONS if fine else _COARSE_ITERATIONS,
            _STEP_PX if fine else _COARSE_STEP_PX,
            isometry=1.0 / _STRAIN_SIGMA**2 if by_light else 0.0,
        )

    def _result(self) -> SurfelFrame:
        return frame_of(
            self._table, frame=self._frame, segment=self._segment, lost=self._lost,
            T_world_camera=self._T_world_camera,
            depth_is_known=self._parameters.depth_from != "flat",
        )  # fmt: skip


def _checked_depth(depth: F64, camera: PinholeCamera) -> F64:
    if depth.shape != (camera.height, camera.width):
        raise ValueError(
            f"expected depth of shape {(camera.height, camera.width)}, got {depth.shape}"
        )
    depth = np.ascontiguousarray(depth, np.float64)
    return np.where(np.isfinite(depth) & (depth > 0.0), depth, 0.0)
