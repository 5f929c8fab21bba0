"""Direct and sparse deformable tracking (DSDT, Lamarca et al. 2022)."""

import numpy as np

from pliant.algorithms.arrays import F32, F64, I64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.algorithms.stages import StageTimer, no_stages
from pliant.algorithms.surfels import judge
from pliant.algorithms.surfels.again import look_again
from pliant.algorithms.surfels.align import Limits, Workspace, align_all, make_workspace
from pliant.algorithms.surfels.birth import find_births
from pliant.algorithms.surfels.joint import Equilibrium, align_jointly, align_rigid, register
from pliant.algorithms.surfels.motion import ILLUMINATION, MODELS
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.prediction import start_at, targets
from pliant.algorithms.surfels.pyramid import make_pyramid, usable_levels
from pliant.algorithms.surfels.rest import Rest, no_rest
from pliant.algorithms.surfels.sampling import BIAS, GAIN, A, B, F, Level, X
from pliant.algorithms.surfels.states import SurfelFrame, SurfelState
from pliant.algorithms.surfels.table import SurfelTable, move_poses
from pliant.algorithms.surfels.together import Hold, align_together

_FOUND_AGAIN_ZNCC = 0.9
"""A surfel that was missing must fit better than one that was followed: chance has had tries."""
_TOGETHER_LEVELS = 2
"""Levels, the finest, at which surfels with neighbours move as one before a static camera."""
_RIGID_SURFELS = 150
"""So many surfels say where the camera is before each of them is looked for."""
_BLENDS = {"template": (0.0, 0.0), "both": (0.5, 1.0), "frame": (1.0, 1.0)}
"""Share of the frame in the derivatives of a patch, at the coarse scales of a static camera and
otherwise: with a moving camera the mean finds fewer surfels again after a jump."""


class SurfelTracker:
    """Follows surfels that move on their own, each by itself, from a depth map on.

    Deterministic: what comes out depends on images, depths and parameters alone.
    """

    def __init__(self, parameters: SurfelParameters) -> None:
        self._parameters = parameters
        self._works: list[Workspace] = []
        self._table = SurfelTable()
        self._camera: PinholeCamera | None = None
        self._T_world_camera: F64 = np.eye(4)
        self._frame, self._segment, self._next_id = 0, 0, 0
        self._lost = True

    def start(
        self, image: U8, depth: F64, camera: PinholeCamera, T_world_camera: F64 | None = None
    ) -> SurfelFrame:
        """Give birth to surfels (section III).

        image: (H, W) uint8.  depth: (H, W) metres, 0 or NaN for holes.  T_world_camera: (4, 4), by
        default the camera's frame is the world.  Raises ValueError for arrays of another size.
        """
        self._camera = camera
        self._table, self._frame, self._segment, self._next_id = SurfelTable(), 0, 0, 0
        self._T_world_camera = np.eye(4) if T_world_camera is None else T_world_camera.copy()
        pyramid = self._pyramid(image)
        self._give_birth(pyramid, _checked_depth(depth, camera))
        return self._result()

    def track(
        self,
        image: U8,
        prediction: F64 | None = None,
        depth: F64 | None = None,
        timer: StageTimer = no_stages,
    ) -> SurfelFrame:
        """Follow all surfels into the next frame.

        image: (H, W) uint8.  prediction: (N, 2) displacements in pixels from the last frame, in the
        order of the last result, NaN where there is none.  depth: (H, W) metres of this frame, for
        new surfels where there is room.  timer: told of each stage.  Raises ValueError before
        ``start``, and for arrays of another size.
        """
        if self._camera is None:
            raise ValueError("track() before start(): surfels need a depth map to begin with")
        with timer("pyramid"):
            pyramid = self._pyramid(image)
        goals = self._goals(prediction, len(pyramid))
        self._frame += 1
        poses = move_poses(self._table.guesses, inverse(self._T_world_camera))
        active = np.ones(len(poses), np.uint8)
        if self._parameters.camera == "static":
            self._start_at(goals, pyramid[-1], poses, active)
            torn = self._align(pyramid, poses, active, timer)
        else:
            torn = self._align_with_camera(pyramid, poses, goals, timer)
        with timer("judge"):
            self._judge(pyramid[0], poses, active, torn)
        if depth is not None:
            with timer("births"):
                self._give_birth(pyramid, _checked_depth(depth, self._camera))
        return self._result()

    def add(self, image: U8, depth: F64, T_world_camera: F64 | None = None) -> SurfelFrame:
        """Give birth to more surfels in the frame that was tracked last, where there is room.

        image: (H, W) uint8 of that frame.  depth: (H, W) in units of the surfels.  T_world_camera:
        (4, 4), where the camera is when tracking is lost: surfels start anew from there.  Raises
        ValueError before ``start``, and for arrays of another size.
        """
        if self._camera is None:
            raise ValueError("add() before start(): surfels need a depth map to begin with")
        if self._lost and T_world_camera is not None:
            self._T_world_camera = T_world_camera.copy()
        self._give_birth(self._pyramid(image), _checked_depth(depth, self._camera))
        return self._result()

    def set_equilibrium(self, ids: I64, positions: F64, covariances: F64) -> None:
        """Say where surfels rest and how far they stray, for example from ``learn_equilibrium``.

        ids: (M,).  positions: (M, 3) metres, world.  covariances: (M, 3, 3) m^2, positive definite.
        Raises ValueError for an id that is not tracked.
        """
        rows = np.searchsorted(self._table.ids, ids)
        rows = np.minimum(rows, max(len(self._table) - 1, 0))
        if len(self._table) == 0 or (self._table.ids[rows] != ids).any():
            raise ValueError("set_equilibrium() names a surfel that is not in the map")
        self._table.rest[rows] = positions
        self._table.information[rows] = np.linalg.inv(covariances)

    def _pyramid(self, image: U8) -> list[Level]:
        camera, p = self._camera, self._parameters
        assert camera is not None
        if image.shape != (camera.height, camera.width) or image.dtype != np.uint8:
            raise ValueError(
                f"expected a uint8 image of shape {(camera.height, camera.width)}, "
                f"got {image.dtype} {image.shape}"
            )
        levels = usable_levels(camera.width, camera.height, p.patch_px, p.levels)
        pyramid = make_pyramid(image, camera, levels, p.patch_px, p.sparse_stride_px)
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
        points = self._table.verdicts[:, judge.U : judge.V + 1]
        return targets(points, prediction, float(2 ** (levels - 1)))

    def _start_at(self, goals: F64 | None, level: Level, poses: F64, active: U8) -> None:
        if goals is not None:
            templates, limits = self._table.templates, self._limits(fine=False)
            if templates:
                start_at(poses, active, goals, level, templates[-1], limits, self._works[-1])

    def _align(self, pyramid: list[Level], poses: F64, active: U8, timer: StageTimer) -> BoolArray:
        """Coarse to fine: the solution of a scale is the guess of the next (section VI-A2)."""
        together = len(self._table.edges.ends) > 0
        start, torn, rest = poses.copy(), np.zeros(len(poses), np.bool_), no_rest(len(poses))
        coarsest = len(pyramid) - 1
        for number in range(coarsest, -1, -1):
            level = pyramid[number]
            # Alone each finds its place in the image; close to it depth would go astray.
            if number == coarsest or number >= _TOGETHER_LEVELS or not together:
                self._align_alone(number, level, poses, active, rest, timer)
            if together and number < _TOGETHER_LEVELS:
                torn = self._hold_together(number, level, poses, start, active, rest, timer)
        return torn

    def _align_alone(
        self, number: int, level: Level, poses: F64, active: U8, rest: Rest, timer: StageTimer
    ) -> None:
        templates, limits = self._table.templates[number], self._limits(fine=number == 0)
        with timer(f"alone, level {number}"):
            align_all(poses, active, rest, level, templates, limits, self._works[number])

    def _hold_together(
        self,
        number: int,
        level: Level,
        poses: F64,
        start: F64,
        active: U8,
        rest: Rest,
        timer: StageTimer,
    ) -> BoolArray:
        p = self._parameters
        steps = p.together_steps if number == 0 else p.coarse_together_steps
        hold = Hold(p.omega_e, p.strain, p.bend, p.tear, steps, p.min_zncc, p.min_visible)
        with timer(f"together, level {number}"):
            return align_together(
                poses, start, active, self._table.edges, rest, level,
                self._table.templates[number], self._limits(fine=number == 0), self._works[number],
                hold,
            )  # fmt: skip

    def _align_with_camera(
        self, pyramid: list[Level], poses: F64, goals: F64 | None, timer: StageTimer
    ) -> BoolArray:
        """Section V: rigid at the coarsest level first, then Eq. 21 from coarse to fine.

        With neighbours camera and surfels take turns: surfels before a camera that is held, then
        the camera that fits them.  The image decides far more of a surfel's place than its
        equilibrium does, so one turn a level comes close.  Returns which surfels have left their
        neighbours.
        """
        table, p, coarsest = self._table, self._parameters, len(pyramid) - 1
        n = len(table)
        followed, everyone = table.tracked.astype(np.uint8), np.ones(n, np.uint8)
        if int(followed.sum()) < p.min_alive:
            followed = everyone
        torn = np.zeros(n, np.bool_)
        together = p.camera == "moving" and len(table.edges.ends) > 0 and coarsest > 0
        T_camera_world = inverse(self._T_world_camera)
        equilibrium = Equilibrium(table.rest, p.omega_e * table.information)
        for number in range(coarsest, -1, -1):
            level, templates = pyramid[number], table.templates[number]
            limits = self._limits(fine=number == 0)
            if number == coarsest or p.camera == "static_map":
                # Turn and shift are nearly the same in the image: a last camera takes short steps.
                share = 0.1 if p.camera == "static_map" else 1.0
                short = limits._replace(min_step_px=share * limits.min_step_px)
                whole = p.camera == "static_map"
                guides = followed if whole else _spread(followed * templates.usable)
                with timer(f"camera alone, level {number}"):
                    T_camera_world = align_rigid(
                        poses, guides, T_camera_world, level, templates, short,
                        self._works[number],
                    )  # fmt: skip
            if p.camera == "static_map":
                continue
            if number == coarsest:
                self._start_at(goals, level, poses, followed)
            if not together:
                with timer(f"camera and surfels, level {number}"):
                    T_camera_world = align_jointly(
                        poses, followed, T_camera_world, equilibrium, level, templates, limits,
                        self._works[number],
                    )  # fmt: skip
                continue
            # What was missing is looked for, too, but says nothing of the camera.
            rest = equilibrium.seen_from(T_camera_world)
            if number > 0:
                self._align_alone(number, level, poses, everyone, rest, timer)
            else:
                start = move_poses(table.guesses, T_camera_world)
                torn = self._hold_together(number, level, poses, start, everyone, rest, timer)
            with timer("camera"):
                T_camera_world = register(poses, followed, T_camera_world, equilibrium)
        self._T_world_camera = inverse(T_camera_world)
        if p.camera == "moving" and not together:
            # What was missing is looked for where the camera says that it should be.
            missing = 1 - followed
            poses[missing > 0] = move_poses(table.guesses, T_camera_world)[missing > 0]
            for number in range(coarsest, -1, -1):
                self._align_alone(number, pyramid[number], poses, missing, no_rest(n), timer)
        return torn

    def _judge(self, level: Level, poses: F64, active: U8, torn: BoolArray) -> None:
        """Keep what was found; what was not stays where it was last good."""
        table, p = self._table, self._parameters
        verdicts, templates, limits = table.verdicts, table.templates[0], self._limits(fine=True)
        judge.judge_all(poses, active, level, templates, limits, self._works[0], verdicts)
        if len(table.edges.ends) and p.camera != "static_map":
            unlike = (verdicts[:, judge.CORRELATION] < p.min_zncc) & (
                verdicts[:, judge.FRONT] > 0.0
            )
            again = (active > 0) & (unlike | torn) & (verdicts[:, judge.INSIDE] >= p.min_visible)
            again = again.astype(np.uint8)
            look_again(
                poses, again, table.edges, level, templates, limits, self._works[0],
                omega_e=p.omega_e, strain=p.strain,
            )  # fmt: skip
            judge.judge_all(poses, again, level, templates, limits, self._works[0], verdicts)
            torn = torn & (again == 0)
        wanted = np.where(table.missing > 0, max(p.min_zncc, _FOUND_AGAIN_ZNCC), p.min_zncc)
        state = np.full(len(table), SurfelState.TRACKED, np.uint8)
        state[verdicts[:, judge.CORRELATION] < wanted] = SurfelState.OUTLIER
        state[verdicts[:, judge.SEEN] < p.min_visible] = SurfelState.OCCLUDED
        state[verdicts[:, judge.INSIDE] < p.min_visible] = SurfelState.OUTSIDE
        state[verdicts[:, judge.FRONT] == 0.0] = SurfelState.OUTSIDE
        state[torn & (state == SurfelState.TRACKED)] = SurfelState.OUTLIER
        good = (state == SurfelState.TRACKED) & np.isfinite(poses).all(axis=1)
        table.missing = np.where(good, 0, table.missing + 1).astype(np.int32)
        state[~good & (table.missing > p.lost_after)] = SurfelState.LOST
        table.state = state
        self._lost = int(good.sum()) < p.min_alive
        world = move_poses(poses, self._T_world_camera)
        finite = np.isfinite(world).all(axis=1, keepdims=True)
        table.tried = np.where(finite, world[:, X : X + 3], table.poses[:, X : X + 3])
        table.poses[good] = world[good]
        # With neighbours, what is not seen is looked for where they have carried it.
        table.guesses = table.poses.copy()
        if p.neighbours and p.camera != "static_map" and not self._lost:
            carried = ~good & np.isfinite(world).all(axis=1)
            table.guesses[carried] = world[carried]

    def _give_birth(self, pyramid: list[Level], depth: F64) -> None:
        table, p, camera = self._table, self._parameters, self._camera
        assert camera is not None
        if self._lost and len(table):
            self._segment += 1
            table.keep(np.zeros(0, np.int64))
        table.keep(np.flatnonzero(table.missing <= p.lost_after + p.forget_after))
        occupied = table.verdicts[table.tracked][:, judge.U : judge.V + 1]
        births = find_births(
            pyramid, depth, camera, p, occupied, p.max_surfels - int(table.tracked.sum())
        )
        n = len(births.poses)
        # The heuristic covariance of section V: a share of the surfel's depth, all directions.
        sigma = p.expected_motion * births.poses[:, X + 2]
        information = np.eye(3) / np.maximum(sigma, 1e-9)[:, None, None] ** 2
        table.add(births, self._T_world_camera, self._next_id, self._frame, information)
        table.connect(len(table) - n, p.neighbours, p.off_plane)
        self._next_id += n
        self._lost = int(table.tracked.sum()) < p.min_alive
        rows = (table.born == self._frame).astype(np.uint8)
        judge.judge_all(
            move_poses(table.poses, inverse(self._T_world_camera)), rows, pyramid[0],
            table.templates[0], self._limits(fine=True), self._works[0], table.verdicts,
        )  # fmt: skip

    def _limits(self, *, fine: bool) -> Limits:
        p = self._parameters
        return Limits(
            MODELS.index(p.model),
            ILLUMINATION[p.illumination],
            _BLENDS[p.jacobian][fine or p.camera != "static"],
            p.saturation,
            p.highlight,
            p.omega_i if p.model != "isometric" else 0.0,
            p.damped_steps,
            p.first_lambda,
            p.start_lambda,
            p.lambda_up,
            p.lambda_down,
            p.fine_iterations if fine else p.coarse_iterations,
            p.fine_step_px if fine else p.coarse_step_px,
            p.stale_px,
            p.slack,
        )

    def _result(self) -> SurfelFrame:
        table = self._table
        poses, verdicts = table.poses, table.verdicts
        f11, f12, f22 = (poses[:, F + k, None] for k in range(3))
        a, b = poses[:, A : A + 3], poses[:, B : B + 3]
        means = table.templates[0].means if table.templates else np.zeros(0)
        # Inside, grey levels have lost the template's mean; outside they are those of Eq. 5.
        biases = poses[:, BIAS] + means * (1.0 - poses[:, GAIN])
        return SurfelFrame(
            frame=self._frame,
            segment=self._segment,
            lost=self._lost,
            T_world_camera=self._T_world_camera.copy(),
            ids=table.ids.copy(),
            positions=poses[:, X : X + 3].copy(),
            tangents=np.stack([f11 * a + f12 * b, f12 * a + f22 * b], axis=2),
            deformations=poses[:, F : F + 3].copy(),
            points_px=_f32(verdicts[:, judge.U : judge.V + 1]),
            zncc=_f32(verdicts[:, judge.CORRELATION]),
            visible=_f32(verdicts[:, judge.SEEN]),
            sigma=_f32(verdicts[:, judge.SIGMA]),
            gains=_f32(poses[:, GAIN]),
            biases=_f32(biases),
            state=table.state.copy(),
            age=(self._frame - table.born).astype(np.int32),
            born=table.born.copy(),
            tried=table.tried.copy(),
        )


def _spread(rows: U8) -> U8:
    """Of the rows that are 1 every so many, ``_RIGID_SURFELS`` or up to twice as many."""
    chosen = np.flatnonzero(rows)
    out = np.zeros_like(rows)
    out[chosen[:: max(1, len(chosen) // _RIGID_SURFELS)]] = 1
    return out


def _checked_depth(depth: F64, camera: PinholeCamera) -> F64:
    if depth.shape != (camera.height, camera.width):
        raise ValueError(
            f"expected depth of shape {(camera.height, camera.width)}, got {depth.shape}"
        )
    depth = np.ascontiguousarray(depth, np.float64)
    return np.where(np.isfinite(depth) & (depth > 0.0), depth, 0.0)


def _f32(values: F64) -> F32:
    return np.ascontiguousarray(values, np.float32)
