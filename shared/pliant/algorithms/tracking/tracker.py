"""Dense tracking of curvature extrema through a video (VITAMIN-E, section 2)."""

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8, with_bits
from pliant.algorithms.image.masks import filled
from pliant.algorithms.image.patch_sums import TEMPLATE_FLOATS
from pliant.algorithms.image.pixels import halve, pixels_of
from pliant.algorithms.stages import StageTimer, no_stages
from pliant.algorithms.tracking.advance import FrameImages, StepLimits, advance_tracks, scan_order
from pliant.algorithms.tracking.bridging import (
    LastSharp,
    are_lost,
    is_as_sharp,
    is_over,
    keep_slots,
    put_back,
    release,
)
from pliant.algorithms.tracking.deformation import WINDOW_SIDE, slopes_of_motion, turn_templates
from pliant.algorithms.tracking.dominant_flow import (
    BriefExtractor,
    BriefFeatures,
    fit_affine,
    match_features,
)
from pliant.algorithms.tracking.local_flow import Flow, grid_shape, local_flow
from pliant.algorithms.tracking.maxima import REACH_PX, curvature_and_maxima, uncovered
from pliant.algorithms.tracking.parameters import TrackingParameters
from pliant.algorithms.tracking.track_table import TRACK, Tracks, TrackTable
from pliant.algorithms.tracking.upkeep import BirthLimits, compact, start_tracks
from pliant.algorithms.tracks import FrameExtrema

MAX_BRIEF_DISTANCE_BITS = 64
"""Maximum distance of 256 bits: beyond, a pair is as likely wrong as right."""

_FLOW_POINTS = 300
"""Maximum BRIEF points for the dominant flow."""

_FLOW_MAX_SHIFT_PX = 180.0
"""Maximum displacement between matched BRIEF points."""

_FLOW_SIGMA_PX = 6.0
"""Scale of the Geman-McClure kernel of the affine fit (Eq. 3)."""

_KAPPA_BITS = 8
"""Significant bits of a published kappa: of a cube of the contrast, sign and size matter."""


class ExtremaTracker:
    """Follows thousands of curvature extrema from frame to frame.

    Deterministic: the tracks depend on the images, the parameters and the seed alone.
    """

    def __init__(
        self, width: int, height: int, parameters: TrackingParameters, seed: int = 0
    ) -> None:
        """Prepare for frames of one size.  seed: of the BRIEF comparisons."""
        self._parameters = parameters
        self._shape = (height, width)
        self._brief = BriefExtractor(np.random.default_rng(seed), _FLOW_POINTS)
        self._table = TrackTable.with_capacity(parameters.max_tracks)
        self._next_id = 0
        self._kappa = np.zeros(self._shape, np.float32)
        self._motions = np.zeros((parameters.max_tracks, 2), np.float32)
        self._scratch = np.zeros(TEMPLATE_FLOATS, np.float32)
        self._rows = np.zeros(parameters.max_tracks, np.int32)
        self._window = np.zeros((WINDOW_SIDE, WINDOW_SIDE), np.float32)
        # Of the frame before; undefined until has_previous.
        self._has_previous = False
        self._lost_at_once = False
        self._kept: LastSharp | None = None  # the frame before most tracks were lost
        self._stamp_ns = 0
        self._smooth = np.zeros(self._shape, np.float32)
        self._spare_smooth = np.zeros(self._shape, np.float32)
        self._pyramid: list[F32] = []
        self._maxima: F32 = np.zeros((0, 3), np.float32)
        self._features: BriefFeatures | None = None
        self._local: F32 = np.zeros((*grid_shape(width, height), 2), np.float32)

    def track(
        self,
        grey: U8,
        stamp_ns: int,
        timer: StageTimer = no_stages,
        clearance: F32 | None = None,
    ) -> FrameExtrema:
        """Track all points into the next frame and start new tracks.

        grey: (H, W) uint8, of the size given at the start.  stamp_ns: capture time, increasing.
        timer: called at each stage.  clearance: (H, W) of its mask, see ``image.masks``; None: the
        whole image.  No maximum and no patch of a track overlaps the mask.  Raises ValueError for
        an image of another size or type.
        """
        if grey.shape != self._shape or grey.dtype != np.uint8:
            raise ValueError(
                f"expected a uint8 image of shape {self._shape}, got {grey.dtype} {grey.shape}"
            )
        p, grey = self._parameters, filled(grey, clearance)
        with timer("curvature and maxima"):
            smooth, _, pixels, maxima = curvature_and_maxima(
                grey,
                p.blur_sigma_px,
                p.min_curvature,
                smooth=self._spare_smooth,
                kappa=self._kappa,
            )
            pixels, maxima = uncovered(pixels, maxima, clearance)
        with timer("dominant flow"):
            features = self._brief.extract(grey, clearance)
            dominant = self._dominant_flow(features)
        with timer("local flow"):
            pyramid = _pyramid(smooth)
            flow = self._local_flow(pyramid, dominant.astype(np.float32).ravel())
        now = FrameImages(pixels_of(smooth), pixels_of(pyramid[0]))
        if self._has_previous:
            with timer("tracks"):
                self._advance(now, flow, 1e-9 * (stamp_ns - self._stamp_ns), clearance)
                if self._kept is not None:
                    self._bridge(self._kept, now, features, pyramid, stamp_ns, clearance)
        with timer("upkeep"):
            self._start_tracks(now, pixels, maxima, clearance)
        self._spare_smooth, self._smooth = self._smooth, smooth
        self._pyramid, self._maxima, self._features = pyramid, maxima, features
        self._local = flow.grid
        self._has_previous, self._stamp_ns = True, stamp_ns
        return self._frame_tracks(maxima, dominant)

    def _dominant_flow(self, features: BriefFeatures) -> F64:
        if self._features is None:
            return np.eye(2, 3)
        return self._flow_between(self._features, features)

    def _flow_between(self, before: BriefFeatures, now: BriefFeatures) -> F64:
        sources, targets = match_features(
            before, now, max_distance_bits=MAX_BRIEF_DISTANCE_BITS, max_shift_px=_FLOW_MAX_SHIFT_PX
        )
        return fit_affine(sources, targets, sigma_px=_FLOW_SIGMA_PX)

    def _local_flow(self, pyramid: list[F32], affine: F32) -> Flow:
        if not self._has_previous:
            return Flow(np.zeros_like(self._local), affine)
        return local_flow(self._pyramid, pyramid, self._maxima, affine, self._local)

    def _advance(
        self, now: FrameImages, flow: Flow, interval_s: float, clearance: F32 | None
    ) -> None:
        table = self._table
        before = FrameImages(pixels_of(self._smooth), pixels_of(self._pyramid[0]))
        tracks_before = table.tracks.view(np.uint8).copy().view(TRACK)  # by fields: 20 times slower
        advance_tracks(
            before,
            now,
            pixels_of(self._kappa),
            flow,
            _step_limits(self._parameters, interval_s),
            scan_order(table.tracks, self._shape[0]),
            self._motions,
            table.tracks,
            table.patches.templates,
            self._scratch,
        )
        _end_covered(table.tracks, clearance)
        at_once = are_lost(table.count, int(table.tracks["alive"].sum()))
        if at_once and not self._lost_at_once and is_as_sharp(self._maxima, self._kept):
            if self._kept is not None:
                release(table, self._kept)
            self._kept = self._last_sharp(tracks_before)
        self._lost_at_once = at_once
        self._compact()
        slopes = slopes_of_motion(table.tracks, flow.affine, *self._shape)
        window = pixels_of(self._window)
        turn_templates(table.tracks, slopes, flow.affine, table.patches, window, self._rows)

    def _start_tracks(
        self, now: FrameImages, pixels: I32, maxima: F32, clearance: F32 | None
    ) -> None:
        table = self._table
        before = table.count
        table.count, table.free_count = start_tracks(
            now,
            pixels,
            maxima,
            _birth_limits(self._parameters),
            self._next_id,
            table.rows,
            table.count,
            table.patches,
            table.free_slots,
            table.free_count,
        )
        self._next_id += table.count - before
        if clearance is not None:  # half-size patches are larger than the distance of maxima
            _end_covered(table.tracks, clearance)
            self._compact()

    def _last_sharp(self, tracks: Tracks) -> LastSharp | None:
        if self._features is None:
            return None
        return LastSharp(
            stamp_ns=self._stamp_ns,
            smooth=self._smooth.copy(),
            pyramid=self._pyramid,
            maxima=self._maxima,
            features=self._features,
            local=self._local,
            tracks=tracks,
        )

    def _bridge(
        self,
        kept: LastSharp,
        now: FrameImages,
        features: BriefFeatures,
        pyramid: list[F32],
        stamp_ns: int,
        clearance: F32 | None,
    ) -> None:
        """Recover tracks that were lost together, by the frame before the loss."""
        table, p = self._table, self._parameters
        lost = kept.lost(table)
        if not is_over(kept, lost, stamp_ns, p.coast_s):
            affine = self._flow_between(kept.features, features)
            flow = local_flow(
                kept.pyramid, pyramid, kept.maxima, affine.astype(np.float32).ravel(),
                np.zeros_like(kept.local),
            )  # fmt: skip
            advance_tracks(
                FrameImages(pixels_of(kept.smooth), pixels_of(kept.pyramid[0])),
                now,
                pixels_of(self._kappa),
                flow,
                _step_limits(p, 1e-9 * (stamp_ns - kept.stamp_ns)),
                scan_order(lost, self._shape[0]),
                np.zeros((len(lost), 2), np.float32),
                lost,
                table.patches.templates,
                self._scratch,
            )
            _end_covered(lost, clearance)
            put_back(table, lost[lost["alive"] == 1])
            lost = lost[lost["alive"] == 0]
        if is_over(kept, lost, stamp_ns, p.coast_s):
            release(table, kept)
            self._kept = None

    def _compact(self) -> None:
        table = self._table
        freed_from = table.free_count
        table.count, table.free_count = compact(
            table.rows, table.count, table.free_slots, table.free_count
        )
        if self._kept is not None:
            keep_slots(table, freed_from, self._kept)

    def _frame_tracks(self, maxima: F32, flow: F64) -> FrameExtrema:
        tracks = self._table.tracks
        return FrameExtrema(
            ids=tracks["id"].copy(),
            points_px=np.column_stack([tracks["u"], tracks["v"]]),
            ages=tracks["age"].copy(),
            kappas=with_bits(tracks["kappa"], _KAPPA_BITS),
            states=tracks["state"].astype(np.uint8),
            maxima=maxima,
            dominant_flow=flow,
        )


def _end_covered(tracks: Tracks, clearance: F32 | None) -> None:
    """End tracks whose patch overlaps the mask."""
    if clearance is None:
        return
    living = np.flatnonzero(tracks["alive"])
    u, v = (np.rint(tracks[name][living]).astype(np.int32) for name in ("u", "v"))
    reach = np.left_shift(REACH_PX, tracks["octave"][living])
    tracks["alive"][living[clearance[v, u] <= reach]] = 0


def _pyramid(image: F32) -> list[F32]:
    """The image at 1/2, 1/4 and 1/8 of its size."""
    half = halve(image)
    quarter = halve(half)
    return [half, quarter, halve(quarter)]


def _step_limits(p: TrackingParameters, interval_s: float) -> StepLimits:
    return StepLimits(
        min_curvature=np.float32(p.min_curvature),
        min_zncc=np.float32(p.min_zncc),
        coast_s=np.float32(p.coast_s),
        interval_s=np.float32(interval_s),
    )


def _birth_limits(p: TrackingParameters) -> BirthLimits:
    return BirthLimits(
        min_strength=np.float32(p.min_strength), fine_strength=np.float32(p.fine_strength)
    )
