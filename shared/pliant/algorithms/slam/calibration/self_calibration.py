"""The estimate of a camera's calibration, refined while the map grows.

The mapper works on pixels and images of an ideal pinhole camera: the measured ones, corrected by
the current estimate of the calibration.  All keyframes are adjusted together with the calibration
each time that their number has grown by a share.  Later frames use the new estimate.
"""

import dataclasses

import numpy as np

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.map_delta import MapDelta
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView, corrected_view
from pliant.algorithms.slam.calibration.held_unknowns import (
    ASPECT,
    PRINCIPAL_POINT,
    freed,
    freed_as,
)
from pliant.algorithms.slam.estimate.observation_table import weigh
from pliant.algorithms.slam.estimate.problem import SHARED, CalibrationUncertainty
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.tracks import FrameExtrema

_GUESS = 0.05
"""Standard deviation of the log focal length from which on a calibration is a guess."""

_LENS = 0.1
"""Standard deviations of k1 and k2 of an unknown camera."""

_OF_LENS = np.arange(SHARED) != 3
"""Which unknowns of a correction move pixels: all but the readout."""

_CERTAIN = 4.0
"""Significance of a rolling shutter's readout, and of a new lens, in standard deviations."""

_UNLIKELY = 1.0
"""Standard deviations of the given calibration by which a new lens must differ from it: a change
during a run costs more than a small error.
"""

_ROLLING = 1.0
"""Standard deviation of the readout of a known rolling shutter."""

_SLOWEST = 0.1
"""Minimum readout of a rolling shutter; other errors look like smaller ones."""

GROWTH = 1.4
"""The map is adjusted with its calibration whenever its keyframes have multiplied by this."""


@dataclasses.dataclass(frozen=True)
class SelfCalibration:
    """A camera: its given calibration with that one's uncertainty, and the current estimate.

    given: the given camera of the rectified images.   uncertainty: of its calibration.
    correction: (SHARED,) of it, see ``solve_schur``.   covariance: (SHARED, SHARED) of that.
    next_keyframes: the number of keyframes at which the calibration is estimated again.
    changes: whether the focal length changes during the clip.   log_focal: of the newest frame
    relative to the correction's: see ``changing_focal``.
    """

    given: PinholeCamera
    correction: F64
    covariance: F64
    next_keyframes: int = 0
    changes: bool = False
    log_focal: float = 0.0
    uncertainty: CalibrationUncertainty = dataclasses.field(default_factory=CalibrationUncertainty)

    @staticmethod
    def of(camera: PinholeCamera, uncertainty: CalibrationUncertainty) -> "SelfCalibration":
        """Return the calibration before any frame."""
        covariance = np.diag(uncertainty.sigmas**2)
        return SelfCalibration(camera, np.zeros(SHARED), covariance, uncertainty=uncertainty)

    @property
    def sigmas(self) -> F64:
        """(SHARED,) standard deviations of the correction."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def weights(self, points_px: F32, *, estimates_k1: bool = False) -> F32:
        """(n,) weights of observations at pixels (n, 2) of the ideal camera, see ``weigh``.

        The distortion k1 is no less certain than given.  k3 is never estimated: a lens with an
        unknown k2 may have a k3 of the same size.   estimates_k1: whether an adjustment estimates
        the error of k1 itself.  While k1 is a guess its error counts even then: a large error is
        explained only step by step, and the border would lead it astray.
        """
        k1 = min(float(self.sigmas[1]), self.uncertainty.k1)
        if estimates_k1 and not self.is_guess:
            k1 = 0.0
        return weigh(points_px, self.view.camera, (k1, self.uncertainty.k2))

    @property
    def is_guess(self) -> bool:
        """Whether the focal length is still a guess."""
        return bool(self.sigmas[0] > _GUESS)

    @property
    def readout(self) -> float:
        """Readout with which frames are mapped, as a share of the frame interval: 0 unless the
        shutter significantly rolls.
        """
        readout = float(self.correction[3])
        return readout if is_certain(readout, self.sigmas[3]) else 0.0

    def with_readout(self, readout: float, sigma: float) -> "SelfCalibration":
        """Return it with an estimated readout and its standard deviation, if that is
        significant.
        """
        correction, covariance = self.correction.copy(), self.covariance.copy()
        correction[3] = readout if is_certain(readout, sigma) else 0.0
        covariance[3, 3] = sigma**2
        return dataclasses.replace(self, correction=correction, covariance=covariance)

    @property
    def in_use(self) -> F64:
        """(SHARED,) the correction in use for mapping."""
        correction = self.correction.copy()
        correction[3] = self.readout
        return correction

    def is_refuted(self, correction: F64, covariance: F64) -> bool:
        """Whether an estimated correction (SHARED,) with its covariance differs significantly
        from the lens in use, and is unlikely under the given uncertainty.
        """
        far = _is_far(correction - self.correction, covariance, _CERTAIN)
        believed = freed(self.uncertainty, PRINCIPAL_POINT, ASPECT)
        return far and _is_far(correction, np.diag(believed.sigmas**2), _UNLIKELY)

    def prior(self, start: F64) -> CalibrationUncertainty:
        """The prior of an adjustment from a correction (SHARED,) towards the given
        calibration: negligible once that is refuted.
        """
        wider: dict[str, float] = {}
        given = self.uncertainty
        if given.readout > 0.0 and start[3]:
            wider["readout"] = max(given.readout, _ROLLING)
        given = freed_as(given, start)
        nothing = dataclasses.replace(self, correction=np.zeros(SHARED), uncertainty=given)
        if nothing.is_refuted(self.correction, self.covariance):
            widths = {"focal": _GUESS, "k1": _LENS, "k2": _LENS}
            known = given.model_dump()
            wider |= {k: max(known[k], width) for k, width in widths.items() if known[k] > 0.0}
        return given.model_copy(update=wider)

    def with_lens(self, correction: F64, covariance: F64) -> "SelfCalibration":
        """Return it with an estimated lens and its covariance; the readout is unchanged."""
        correction = np.where(_OF_LENS, correction, self.correction)
        both = _OF_LENS[:, None] & _OF_LENS
        return dataclasses.replace(
            self, correction=correction, covariance=np.where(both, covariance, self.covariance)
        )

    def sees_like(self, other: "SelfCalibration") -> bool:
        """Whether both have the same pixels, whatever their readouts."""
        one, view = self.view, other.view
        return (one.camera, one.lens) == (view.camera, view.lens)

    @property
    def view(self) -> CorrectedView:
        """The view from pixels of the rectified image to those of the ideal camera."""
        return self.view_at(0.0)

    @property
    def frame_view(self) -> CorrectedView:
        """As ``view``, for the newest frame with its own focal length."""
        return self.view_at(self.log_focal)

    def view_at(self, log_focal: float) -> CorrectedView:
        """As ``view``, for another focal length."""
        return corrected_view(self.given, tuple(self.correction.tolist()), log_focal)

    def ideal(self, tracks: FrameExtrema) -> FrameExtrema:
        """Convert tracks to the ideal camera."""
        view = self.frame_view
        if view.lens == (0.0, 0.0) and self.log_focal == 0.0:
            return tracks
        maxima = tracks.maxima.copy()
        maxima[:, :2] = view.pixels(tracks.maxima[:, :2])
        return dataclasses.replace(tracks, points_px=view.pixels(tracks.points_px), maxima=maxima)

    def published_with(self, delta: MapDelta) -> MapDelta:
        """Return the published form, with the calibration that the map was made with."""
        if not self.correction.any():
            return delta
        return dataclasses.replace(
            delta,
            calibration_correction=tuple(self.correction.tolist()),
            calibration_sigmas=tuple(self.sigmas.tolist()),
        )

    def corrected(self, correction: F64, covariance: F64, keyframes: int) -> "SelfCalibration":
        """Return it with the estimate from a number of keyframes."""
        following = max(keyframes + 1, int(np.ceil(GROWTH * keyframes)))
        return dataclasses.replace(
            self, correction=correction, covariance=covariance, next_keyframes=following
        )


def _is_far(step: F64, covariance: F64, sigmas: float) -> bool:
    """Whether the Mahalanobis distance, without the readout, is significant."""
    unknown = (np.diag(covariance) > 0.0) & _OF_LENS
    C = covariance[np.ix_(unknown, unknown)]
    if not unknown.any() or not np.isfinite(C).all():
        return False
    return float(step[unknown] @ np.linalg.solve(C, step[unknown])) > sigmas**2


def is_certain(readout: float, sigma: float) -> bool:
    """Whether a readout with this standard deviation is significant."""
    return abs(readout) > max(_CERTAIN * sigma, _SLOWEST)


def widened(parameters: MappingParameters, focal_sigma: float) -> MappingParameters:
    """Return the uncertainty for a source with this standard deviation of the log focal length; 0:
    calibrated.

    A guessed focal length implies an unknown lens.  Fixed parameters stay fixed.
    """
    prior = parameters.calibration
    if focal_sigma <= prior.focal or prior.focal == 0.0:
        return parameters
    wider: dict[str, float] = {"focal": focal_sigma}
    if focal_sigma > _GUESS:
        wider |= {"k1": max(prior.k1, _LENS), "k2": max(prior.k2, _LENS)}
        prior = freed(prior, PRINCIPAL_POINT)
    return parameters.model_copy(update={"calibration": prior.model_copy(update=wider)})


def is_guess(uncertainty: CalibrationUncertainty) -> bool:
    """Whether a calibration is so uncertain that a map needs a better one first."""
    return uncertainty.focal > _GUESS
