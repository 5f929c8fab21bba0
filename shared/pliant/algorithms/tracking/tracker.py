"""Dense tracking of curvature extrema through a video (VITAMIN-E, section 2)."""

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8
from pliant.algorithms.image.downsampling import halve
from pliant.algorithms.image.patch_sums import TEMPLATE_FLOATS
from pliant.algorithms.stages import StageTimer, no_stages
from pliant.algorithms.tracking import step_limits as step
from pliant.algorithms.tracking.advance import advance_tracks, scan_order
from pliant.algorithms.tracking.climbing import climb_points
from pliant.algorithms.tracking.deformation import (
    WINDOW_SIDE,
    slopes_of_motion,
    turn_templates,
)
from pliant.algorithms.tracking.dominant_flow import (
    BriefExtractor,
    BriefFeatures,
    fit_affine,
    match_features,
)
from pliant.algorithms.tracking.local_flow import grid_shape, local_flow
from pliant.algorithms.tracking.maxima import curvature_and_maxima
from pliant.algorithms.tracking.parameters import TrackingParameters
from pliant.algorithms.tracking.track_table import AGE, KAPPA, STATE, TrackTable, U, V
from pliant.algorithms.tracking.upkeep import compact, remove_doubles, start_tracks
from pliant.algorithms.tracks import FrameTracks

MAX_BRIEF_DISTANCE_BITS = 64
"""Of 256: beyond this a pair is as likely chance as not."""

MIN_REFIT_TRACKS, MAX_REFIT_TRACKS = 50, 500
"""Tracks that the affine is fitted to again."""


class ExtremaTracker:
    """Follows thousands of curvature extrema from frame to frame.

    Deterministic: the tracks depend on the images, the parameters and the seed alone.
    """

    def __init__(
        self, width: int, height: int, parameters: TrackingParameters, seed: int = 0
    ) -> None:
        """Prepare for frames of one size.  seed: of the comparisons that BRIEF makes."""
        self._parameters = parameters
        self._shape = (height, width)
        self._brief = BriefExtractor(np.random.default_rng(seed), parameters.flow_points)
        self._table = TrackTable.with_capacity(parameters.max_tracks)
        self._next_id = 0
        self._limits, self._switches = _kernel_arguments(parameters)
        self._owners = np.zeros(self._shape, np.int32)
        self._motions = np.zeros((parameters.max_tracks, 2), np.float32)
        self._scratch = np.zeros(TEMPLATE_FLOATS, np.float32)
        self._rows = np.zeros(parameters.max_tracks, np.int32)
        self._window = np.zeros(WINDOW_SIDE**2, np.float32)
        # Of the frame before; none of them means anything until has_previous.
        self._has_previous = False
        self._smooth = np.zeros(self._shape, np.float32)
        self._kappa = np.zeros(self._shape, np.float32)
        self._spare_smooth = np.zeros(self._shape, np.float32)
        self._spare_kappa = np.zeros(self._shape, np.float32)
        self._pyramid: list[F32] = []
        self._maxima: F32 = np.zeros((0, 3), np.float32)
        self._features: BriefFeatures | None = None
        self._local: F32 = np.zeros((*grid_shape(width, height), 2), np.float32)

    def track(self, grey: U8, timer: StageTimer = no_stages) -> FrameTracks:
        """Follow all tracks into the next frame and start new ones.

        grey: (H, W) uint8, of the size given at the start.  timer: told of each stage.  Raises
        ValueError for an image of another size or type.
        """
        if grey.shape != self._shape or grey.dtype != np.uint8:
            raise ValueError(
                f"expected a uint8 image of shape {self._shape}, got {grey.dtype} {grey.shape}"
            )
        p = self._parameters
        with timer("curvature and maxima"):
            smooth, kappa, pixels, maxima = curvature_and_maxima(
                grey,
                p.blur_sigma_px,
                p.min_curvature,
                both_signs=p.both_signs,
                smooth=self._spare_smooth,
                kappa=self._spare_kappa,
            )
        with timer("dominant flow"):
            features = self._brief.extract(grey)
            flow = self._dominant_flow(features)
            if p.affine_refit:
                flow = self._refit(kappa, flow)
        with timer("local flow"):
            pyramid = _pyramid(smooth)
            half = pyramid[0]
            local = self._local_flow(pyramid, flow)
        if self._has_previous:
            with timer("tracks"):
                self._advance(smooth, half, kappa, flow, local)
        with timer("upkeep"):
            self._start_tracks(smooth, half, pixels, maxima)
        self._spare_smooth, self._smooth = self._smooth, smooth
        self._spare_kappa, self._kappa = self._kappa, kappa
        self._pyramid, self._maxima, self._features = pyramid, maxima, features
        self._local = local
        self._has_previous = True
        return self._frame_tracks(maxima, flow)

    def _dominant_flow(self, features: BriefFeatures) -> F64:
        if self._features is None:
            return np.eye(2, 3)
        sources, targets = match_features(
            self._features,
            features,
            max_distance_bits=MAX_BRIEF_DISTANCE_BITS,
            max_shift_px=self._parameters.flow_max_shift_px,
        )
        return fit_affine(sources, targets, sigma_px=self._parameters.flow_sigma_px)

    def _refit(self, kappa: F32, flow: F64) -> F64:
        """Fit the affine twice more, to tracks that climbed where the last fit sent them."""
        p, table = self._parameters, self._table
        if table.count < MIN_REFIT_TRACKS:
            return flow
        rows = np.arange(0, table.count, -(-table.count // MAX_REFIT_TRACKS))
        points, kappas = table.floats[rows, U : V + 1], table.floats[rows, KAPPA]
        for _ in range(2):
            predictions = (points @ flow[:, :2].T + flow[:, 2]).astype(np.float32)
            pairs = climb_points(
                kappa, points, predictions, kappas, np.float32(p.prediction_sigma_px)
            )
            if len(pairs) < MIN_REFIT_TRACKS:
                return flow
            flow = fit_affine(
                np.ascontiguousarray(pairs[:, :2]),
                np.ascontiguousarray(pairs[:, 2:]),
                sigma_px=p.prediction_sigma_px,
            )
        return flow

    def _local_flow(self, pyramid: list[F32], flow: F64) -> F32:
        if not (self._parameters.local_flow and self._has_previous):
            return np.zeros_like(self._local)
        return local_flow(self._pyramid, pyramid, self._maxima, flow, self._local)

    def _advance(self, smooth: F32, half: F32, kappa: F32, flow: F64, local: F32) -> None:
        table = self._table
        advance_tracks(
            self._smooth,
            smooth,
            self._pyramid[0],
            half,
            self._kappa,
            kappa,
            local,
            flow.astype(np.float32).ravel(),
            self._limits,
            self._switches,
            scan_order(table.count, table.floats, self._shape[0]),
            self._motions,
            table.floats,
            table.ints,
            table.templates,
            self._scratch,
        )
        if self._parameters.deduplicate:
            remove_doubles(table.count, table.floats, table.ints, self._owners)
        table.count, table.free_count = compact(
            table.count, table.free_count, table.ids, table.floats, table.ints, table.free_slots
        )
        if self._parameters.patch_refinement and self._parameters.turn_patches:
            affine = flow.astype(np.float32).ravel()
            slopes = slopes_of_motion(table.count, table.floats, affine, *self._shape)
            turn_templates(
                table.count,
                table.floats,
                table.ints,
                slopes,
                affine,
                table.births,
                table.deformations,
                table.templates,
                self._window,
                self._rows,
            )

    def _start_tracks(self, smooth: F32, half: F32, pixels: I32, maxima: F32) -> None:
        p, table = self._parameters, self._table
        before = table.count
        table.count, table.free_count = start_tracks(
            smooth,
            half,
            pixels,
            maxima,
            p.spacing_px,
            p.cell_px,
            np.float32(p.min_strength),
            np.float32(p.fine_strength),
            np.float32(p.min_isotropy),
            p.subpixel,
            p.patch_refinement,
            self._next_id,
            table.count,
            table.free_count,
            table.ids,
            table.floats,
            table.ints,
            table.templates,
            table.births,
            table.deformations,
            table.free_slots,
        )
        self._next_id += table.count - before

    def _frame_tracks(self, maxima: F32, flow: F64) -> FrameTracks:
        table, n = self._table, self._table.count
        return FrameTracks(
            ids=table.ids[:n].copy(),
            points_px=table.floats[:n, U : V + 1].copy(),
            ages=table.ints[:n, AGE].copy(),
            kappas=table.floats[:n, KAPPA].copy(),
            states=table.ints[:n, STATE].astype(np.uint8),
            maxima=maxima,
            dominant_flow=flow,
        )


def warm_up() -> None:
    """Compile every kernel of the tracker, with the types that real frames have."""
    rng = np.random.default_rng(0)
    grey = rng.integers(0, 256, (120, 160), np.uint8)
    for parameters in (TrackingParameters(), TrackingParameters(affine_refit=True)):
        tracker = ExtremaTracker(160, 120, parameters)
        for _ in range(2):
            tracker.track(grey)


def _pyramid(image: F32) -> list[F32]:
    """The image at 1/2, 1/4 and 1/8 of its size."""
    half = halve(image)
    quarter = halve(half)
    return [half, quarter, halve(quarter)]


def _kernel_arguments(p: TrackingParameters) -> tuple[F32, I32]:
    """The parameters in the order of the columns that the kernels expect."""
    limits = np.zeros(step.LIMITS, np.float32)
    limits[step.PREDICTION_WEIGHT] = p.prediction_weight
    limits[step.PREDICTION_SIGMA] = p.prediction_sigma_px
    limits[step.MAX_CORRECTION] = p.max_correction_px
    limits[step.MUTUAL_GATE] = p.mutual_gate_px
    limits[step.MIN_CURVATURE] = p.min_curvature
    limits[step.MIN_ZNCC] = p.min_zncc
    limits[step.REFRESH_ZNCC] = p.refresh_zncc
    limits[step.MIN_RESIDUAL] = p.min_residual
    limits[step.MIN_STRENGTH] = p.min_strength
    limits[step.EXTREMUM_GATE] = p.extremum_gate_px
    limits[step.COAST_GATE] = p.coast_gate_px
    limits[step.BACKWARD_GATE] = p.backward_gate_px
    switches = np.zeros(step.SWITCHES, np.int32)
    switches[step.MUTUAL_CHECK] = p.mutual_check
    switches[step.SUBPIXEL] = p.subpixel
    switches[step.PATCH_REFINEMENT] = p.patch_refinement
    switches[step.PATCH_ITERATIONS] = p.patch_iterations
    switches[step.COAST_FRAMES] = p.coast_frames
    return limits, switches
