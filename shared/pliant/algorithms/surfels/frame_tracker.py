"""Tracks a table of surfels into a frame, and its camera (DSDT, sections V and VI)."""

from dataclasses import dataclass, field

import numpy as np

from pliant.algorithms.arrays import F64, I64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.stages import StageTimer
from pliant.algorithms.surfels import validation
from pliant.algorithms.surfels.camera_alignment import align_rigid, fit_camera, spread
from pliant.algorithms.surfels.deformation_models import MODELS, move_poses
from pliant.algorithms.surfels.graph_alignment import COARSE_STEPS, STEPS, align_graph, relocate
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.patch_sampling import Level, X, make_pyramid, usable_levels
from pliant.algorithms.surfels.prediction import start_at, targets
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
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.algorithms.surfels.surfel_table import SurfelTable
from pliant.algorithms.surfels.template_update import RELOCATED_ZNCC, TemplateUpdate

_TOGETHER_LEVELS, _FEWER_TOGETHER = 2, 1
"""Levels, the finest, at which surfels with neighbours move as one.  Fewer before a moving camera,
where more take twice as long and the camera is hardly better, and on made-up depth, whose shape is
wrong: at half the size it would lead to where the image does not fit."""
_BLEND, _COARSE_STATIC_BLEND = 1.0, 0.5
"""Share of the frame in the derivatives of a patch; the rest is the texture's.  At the coarse
scales of a static camera their mean converges most often (second order, as in ESM); before a moving
one it finds fewer surfels again after a jump."""
_ITERATIONS, _COARSE_ITERATIONS = 10, 6
_STRAIN_SIGMA = 0.01
"""Of the soft isometry with a lamp at the camera."""
_STEP_PX, _COARSE_STEP_PX = 0.01, 0.05


@dataclass(kw_only=True)
class Segment:
    """Surfels of one world, and the camera in it.

    number: of the segment.    T_world_camera: (4, 4) in the last frame.    lost: whether too few
    surfels were tracked in it.
    """

    number: int = 0
    table: SurfelTable = field(default_factory=SurfelTable)
    T_world_camera: F64 = field(default_factory=lambda: np.eye(4))
    lost: bool = True

    def in_camera(self) -> F64:
        """(N, POSE_FLOATS) last good poses in the camera's frame."""
        return move_poses(self.table.poses, inverse(self.T_world_camera))


@dataclass
class FrameTracker:
    """works: scratch of each level of the pyramid."""

    parameters: SurfelParameters
    works: list[Workspace] = field(default_factory=list[Workspace])

    def pyramid(self, image: U8, camera: PinholeCamera) -> list[Level]:
        """Levels of an image (H, W), the finest first.  Raises ValueError for another size."""
        p = self.parameters
        if image.shape != (camera.height, camera.width) or image.dtype != np.uint8:
            raise ValueError(
                f"expected a uint8 image of shape {(camera.height, camera.width)}, "
                f"got {image.dtype} {image.shape}"
            )
        levels = usable_levels(camera.width, camera.height, p.patch_px, p.levels)
        pyramid = make_pyramid(image, camera, levels, p.patch_px)
        if len(self.works) != len(pyramid):
            self.works = [make_workspace(level.side) for level in pyramid]
        return pyramid

    def follow(
        self,
        segment: Segment,
        pyramid: list[Level],
        prediction: F64 | None,
        interval_s: float,
        timer: StageTimer,
    ) -> None:
        """Move surfels and camera from the last frame to this one.

        prediction: (N, 2) displacements in pixels, NaN where there is none.    interval_s: between
        the frames.  Raises ValueError for a prediction of another size.
        """
        goals = _goals(prediction, segment.table, len(pyramid))
        poses = move_poses(segment.table.guesses, inverse(segment.T_world_camera))
        torn = self._align(segment, pyramid, poses, goals, timer)
        with timer("validation"):
            self._validate(segment, pyramid[0], poses, torn, interval_s)

    def measure(self, segment: Segment, level: Level, rows: I64) -> None:
        """Validate some surfels where they are.  level: of full size."""
        table, active = segment.table, np.zeros(len(segment.table), np.uint8)
        active[rows] = 1
        matcher = self.matcher(table, 0, level)
        validation.validate_all(segment.in_camera(), active, matcher, table.validations)

    def update_templates(self, segment: Segment, pyramid: list[Level], frame: int) -> None:
        """Confirm, search and renew.  frame: its number, which selects the surfels to search."""
        table = segment.table
        matchers = [
            self.matcher(table, number, level)._replace(templates=table.birth[number])
            for number, level in enumerate(pyramid)
        ]
        TemplateUpdate(table, self.parameters, pyramid, matchers, segment.T_world_camera).run(frame)

    def _align(
        self,
        segment: Segment,
        pyramid: list[Level],
        poses: F64,
        goals: F64 | None,
        timer: StageTimer,
    ) -> BoolArray:
        """Coarse to fine: the solution of a scale initialises the next (section VI-A2).

        A moving camera is first estimated as if the scene were rigid.  Then camera and surfels
        alternate: surfels with a fixed camera, then the camera that fits them.  The image
        determines a surfel's position far more than its equilibrium, so one alternation per level
        is sufficient.  Returns which surfels have left their neighbours.
        """
        table, moving, n = segment.table, self.parameters.camera == "moving", len(poses)
        everyone, torn, coarsest = np.ones(n, np.uint8), np.zeros(n, np.bool_), len(pyramid) - 1
        # Missing surfels are searched too, but do not determine the camera.
        guides = table.tracked.astype(np.uint8)
        if not moving or int(guides.sum()) < self.parameters.min_alive:
            guides = everyone
        T_camera_world, equilibrium = inverse(segment.T_world_camera), no_equilibrium(n)
        start, weights = poses, OMEGA_E / table.sigmas**2
        made_up = self.parameters.depth_from == "flat"
        together = _FEWER_TOGETHER if moving or made_up else _TOGETHER_LEVELS
        together = together if len(table.edges.ends) else 0
        for number in range(coarsest, -1, -1):
            level = pyramid[number]
            matcher = self.matcher(table, number, level)
            if number == coarsest:
                if moving:
                    some = spread(guides * matcher.templates.usable)
                    with timer("camera alone"):
                        T_camera_world = align_rigid(poses, some, T_camera_world, matcher)
                if goals is not None and table.templates:
                    start_at(poses, guides, goals, matcher)
                start = poses.copy()
            if moving:
                equilibrium = Equilibrium(transform(T_camera_world, table.rest), weights)
                start = move_poses(table.guesses, T_camera_world)
            if not moving and made_up and number == together - 1:
                _stay_where_it_fits(matcher, start, poses)
            # Alone each surfel finds its pixel; close to it its depth would drift.
            if number == coarsest or number >= together:
                with timer(f"alone, level {number}"):
                    align_all(poses, everyone, equilibrium, matcher)
            if number < together:
                with timer(f"together, level {number}"):
                    torn = align_graph(
                        poses, start, everyone, table.edges, equilibrium, matcher,
                        self.parameters, STEPS if number == 0 else COARSE_STEPS,
                        None if self.parameters.light == "any" else table.brightness,
                    )  # fmt: skip
            if moving:
                with timer("camera"):
                    T_camera_world = fit_camera(
                        poses, guides, T_camera_world, table.rest, weights, across=table.settled
                    )
        if moving:
            segment.T_world_camera = inverse(T_camera_world)
        return torn

    def _validate(
        self, segment: Segment, level: Level, poses: F64, torn: BoolArray, interval_s: float
    ) -> None:
        """Keep the tracked surfels; the others keep their last good estimate."""
        table, p = segment.table, self.parameters
        found, matcher = table.validations, self.matcher(table, 0, level)
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
        table.missing = np.where(good, 0.0, table.missing + interval_s)
        state[~good & (table.missing > p.lost_after_s)] = SurfelState.LOST
        table.state = state
        segment.lost = int(good.sum()) < p.min_alive
        if segment.lost:  # surfels are never dropped in the dark
            table.missing = np.minimum(table.missing, p.lost_after_s)
        world = move_poses(poses, segment.T_world_camera)
        finite = np.isfinite(world).all(axis=1, keepdims=True)
        table.tried = np.where(finite, world[:, X : X + 3], table.poses[:, X : X + 3])
        table.poses[good] = world[good]
        # With neighbours, invisible surfels are searched at their position.
        table.guesses = table.poses.copy()
        if p.neighbours and not segment.lost:
            carried = ~good & np.isfinite(world).all(axis=1)
            table.guesses[carried] = world[carried]

    def matcher(self, table: SurfelTable, number: int, level: Level) -> Matcher:
        """Of the templates in use.  number: of the level, 0 being that of full size."""
        return Matcher(
            level, table.templates[number], self.limits(fine=number == 0), self.works[number]
        )

    def limits(self, *, fine: bool) -> Limits:
        """fine: at full size."""
        p = self.parameters
        coarse_static, by_light = not fine and p.camera == "static", p.light != "any"
        return Limits(
            MODELS["general" if by_light else p.model],
            _COARSE_STATIC_BLEND if coarse_static else _BLEND,
            p.highlight,
            _ITERATIONS if fine else _COARSE_ITERATIONS,
            _STEP_PX if fine else _COARSE_STEP_PX,
            isometry=1.0 / _STRAIN_SIGMA**2 if by_light else 0.0,
        )


def _goals(prediction: F64 | None, table: SurfelTable, levels: int) -> F64 | None:
    """Predicted pixels at the coarsest level."""
    if prediction is None:
        return None
    if prediction.shape != (len(table), 2):
        raise ValueError(
            f"expected a prediction of shape {(len(table), 2)}, got {prediction.shape}"
        )
    points = table.validations[:, validation.U : validation.V + 1]
    return targets(points, prediction, float(2 ** (levels - 1)))


def _stay_where_it_fits(matcher: Matcher, start: F64, poses: F64) -> None:
    """Undo the coarse scales where they do not raise the ZNCC.

    A patch of a coarse scale covers more of the scene: what deforms, or an instrument, moves it.
    Near by, the fine scales then end in another minimum.  With a measured depth it gains nothing.
    start: poses before the coarse scales.  poses: after them, overwritten.
    """
    everyone = np.ones(len(poses), np.uint8)
    before = evaluate_all(start, everyone, matcher, zncc=True)
    after = evaluate_all(poses, everyone, matcher, zncc=True)
    stay = before.zncc >= after.zncc
    poses[stay] = start[stay]
