"""Positions on the Earth: WGS84, Earth-centred (ECEF), and local east, north and up (ENU).

WGS84 (NGA.STND.0036) is an ellipsoid of revolution with semi-major axis a and flattening f, hence
b = a (1 - f) and e^2 = f (2 - f).  A point at latitude phi and longitude lambda lies h above it
along its normal.  The normal meets the axis at N = a / sqrt(1 - e^2 sin^2 phi) below the surface:

    x = (N + h) cos phi cos lambda
    y = (N + h) cos phi sin lambda
    z = (N (1 - e^2) + h) sin phi
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64

SEMI_MAJOR_M = 6_378_137.0
FLATTENING = 1.0 / 298.257223563
_E2 = FLATTENING * (2.0 - FLATTENING)
_SEMI_MINOR_M = SEMI_MAJOR_M * (1.0 - FLATTENING)
_ROUNDS = 5
"""Of Bowring's iteration; the third is below a nanometre at any height above -4000 km."""


@dataclass(frozen=True, kw_only=True)
class EnuOrigin:
    """Where a local frame lies: x east, y north, z up along the normal of the ellipsoid."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    @property
    def ecef_m(self) -> F64:
        """(3,): its position in the Earth's frame."""
        return ecef_of(
            np.array([self.latitude_deg]),
            np.array([self.longitude_deg]),
            np.array([self.altitude_m]),
        )[0]

    @property
    def R_enu_ecef(self) -> F64:
        """(3, 3): rows are east, north and up, the derivatives of the formulas above by lambda,
        phi and h, normalised."""
        phi, lam = np.radians(self.latitude_deg), np.radians(self.longitude_deg)
        sin_phi, cos_phi, sin_lam, cos_lam = np.sin(phi), np.cos(phi), np.sin(lam), np.cos(lam)
        return np.array(
            [
                [-sin_lam, cos_lam, 0.0],
                [-sin_phi * cos_lam, -sin_phi * sin_lam, cos_phi],
                [cos_phi * cos_lam, cos_phi * sin_lam, sin_phi],
            ]
        )


def ecef_of(latitude_deg: F64, longitude_deg: F64, altitude_m: F64) -> F64:
    """(N, 3) metres in the Earth's frame of (N,) positions; altitudes above the ellipsoid."""
    phi, lam = np.radians(latitude_deg), np.radians(longitude_deg)
    normal = SEMI_MAJOR_M / np.sqrt(1.0 - _E2 * np.sin(phi) * np.sin(phi))
    across = (normal + altitude_m) * np.cos(phi)
    along = (normal * (1.0 - _E2) + altitude_m) * np.sin(phi)
    return np.stack([across * np.cos(lam), across * np.sin(lam), along], axis=-1)


def geodetic_of(ecef_m: F64) -> tuple[F64, F64, F64]:
    """(N,) latitudes and longitudes in degrees and altitudes in metres of (N, 3) positions.

    Bowring (Survey Review 1976): with the reduced latitude beta, tan beta = (1 - f) tan phi, the
    centre of curvature of the meridian is at (e^2 a cos^3 beta, -e'^2 b sin^3 beta), e'^2 =
    e^2 / (1 - e^2), and the normal through the point leads through it.  So phi follows from beta,
    and beta from phi, again and again.  The height is the distance along the normal,
    p cos phi + z sin phi - a sqrt(1 - e^2 sin^2 phi), which is good at poles and equator alike.
    """
    x, y, z = np.moveaxis(np.asarray(ecef_m, float), -1, 0)
    p = np.hypot(x, y)
    beta = np.arctan2(z, (1.0 - FLATTENING) * p)
    phi = beta
    for _ in range(_ROUNDS):
        sin, cos = np.sin(beta), np.cos(beta)
        phi = np.arctan2(
            z + _E2 / (1.0 - _E2) * _SEMI_MINOR_M * sin * sin * sin,
            p - _E2 * SEMI_MAJOR_M * cos * cos * cos,
        )
        beta = np.arctan2((1.0 - FLATTENING) * np.sin(phi), np.cos(phi))
    sin = np.sin(phi)
    altitude = p * np.cos(phi) + z * sin - SEMI_MAJOR_M * np.sqrt(1.0 - _E2 * sin * sin)
    return np.degrees(phi), np.degrees(np.arctan2(y, x)), altitude


def enu_of(latitude_deg: F64, longitude_deg: F64, altitude_m: F64, origin: EnuOrigin) -> F64:
    """(N, 3) metres east, north and up of an origin."""
    ecef = ecef_of(latitude_deg, longitude_deg, altitude_m)
    return (ecef - origin.ecef_m) @ origin.R_enu_ecef.T


def geodetic_of_enu(enu_m: F64, origin: EnuOrigin) -> tuple[F64, F64, F64]:
    """The inverse of ``enu_of``: latitudes, longitudes, altitudes of (N, 3) local positions."""
    return geodetic_of(np.asarray(enu_m, float) @ origin.R_enu_ecef + origin.ecef_m)
