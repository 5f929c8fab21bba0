"""Positions on the Earth, compared with the lengths of degrees that geodesists publish."""

import numpy as np
import pytest

from pliant.algorithms.inertial.geodesy import (
    SEMI_MAJOR_M,
    EnuOrigin,
    ecef_of,
    enu_of,
    geodetic_of,
    geodetic_of_enu,
)


def test_axes_of_the_ellipsoid() -> None:
    places = ecef_of(
        np.array([0.0, 0.0, 90.0, -90.0]), np.array([0.0, 90.0, 0.0, 0.0]), np.zeros(4)
    )
    expected = [[SEMI_MAJOR_M, 0, 0], [0, SEMI_MAJOR_M, 0], [0, 0, 6356752.314245]]
    assert places[:3] == pytest.approx(np.array(expected), abs=1e-6)
    assert places[3, 2] == pytest.approx(-6356752.314245, abs=1e-6)


@pytest.mark.parametrize(
    ("latitude", "of_latitude", "of_longitude"),
    # NGA, Length of a degree of latitude and longitude, WGS84.
    [(0.0, 110574.3, 111319.5), (45.0, 111131.7, 78846.8), (60.0, 111412.2, 55800.0)],
)
def test_lengths_of_a_degree(latitude: float, of_latitude: float, of_longitude: float) -> None:
    origin = EnuOrigin(latitude_deg=latitude, longitude_deg=8.5, altitude_m=0.0)
    part = 1e-3
    enu = enu_of(
        np.array([latitude + part / 2, latitude - part / 2, latitude]),
        np.array([8.5, 8.5, 8.5 + part]),
        np.zeros(3),
        origin,
    )
    assert (enu[0, 1] - enu[1, 1]) / part == pytest.approx(of_latitude, abs=0.2)
    assert enu[2, 0] / part == pytest.approx(of_longitude, abs=0.2)


def test_there_and_back_everywhere() -> None:
    rng = np.random.default_rng(0)
    latitude = np.concatenate([rng.uniform(-90, 90, 500), [90.0, -90.0, 0.0]])
    longitude = np.concatenate([rng.uniform(-180, 180, 500), [0.0, 0.0, 180.0]])
    altitude = np.concatenate([rng.uniform(-10_000, 1_000_000, 500), [0.0, 100.0, -5.0]])
    back = geodetic_of(ecef_of(latitude, longitude, altitude))
    assert back[0] == pytest.approx(latitude, abs=1e-11)
    assert back[1][:500] == pytest.approx(longitude[:500], abs=1e-11)
    assert back[2] == pytest.approx(altitude, abs=2e-8)


def test_local_frame_is_a_rotation_and_comes_back() -> None:
    origin = EnuOrigin(latitude_deg=-33.9, longitude_deg=151.2, altitude_m=58.0)
    R = origin.R_enu_ecef
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(R) == pytest.approx(1.0)
    enu = np.random.default_rng(1).normal(0.0, 3000.0, (100, 3))
    back = enu_of(*geodetic_of_enu(enu, origin), origin)
    assert back == pytest.approx(enu, abs=1e-7)
    latitude, _, altitude = geodetic_of_enu(np.array([[0.0, 0.0, 10.0]]), origin)
    assert (latitude[0], altitude[0]) == pytest.approx((-33.9, 68.0))
