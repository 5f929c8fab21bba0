"""A trajectory and satellite fixes of it: the similarity between them, and how sure it is."""

from dataclasses import replace

import numpy as np
import pytest

from pliant.algorithms.geometry import so3_exp
from pliant.algorithms.inertial.geodesy import EnuOrigin, geodetic_of_enu
from pliant.algorithms.inertial.gps_fit import (
    GpsFit,
    GpsRefusal,
    Problem,
    State,
    fit_to_fixes,
    linearised,
    moved_by,
)
from pliant.algorithms.inertial.samples import GpsFixes

ORIGIN = EnuOrigin(latitude_deg=47.4, longitude_deg=8.5, altitude_m=400.0)
SCALE, TURN = 2.5, so3_exp(np.array([0.3, -1.1, 2.0]))
OFFSET_S = 0.35


def path(seconds: float, *, straight: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """(stamps, ENU positions) of a walk: 30 frames a second."""
    times = np.arange(0.0, seconds, 1 / 30)
    if straight:
        return (1e9 * times).astype(np.int64), np.outer(1.4 * times, [0.6, 0.8, 0.0])
    turns = np.stack(
        [30 * np.sin(0.11 * times), 20 * np.sin(0.17 * times + 1), 4 * np.sin(0.07 * times)], axis=1
    )
    return (1e9 * times).astype(np.int64), turns


def measured(
    stamps: np.ndarray,
    enu: np.ndarray,
    *,
    seed: int,
    noise_m: float = 1.0,
    correlation: float = 0.0,
    said: bool = False,
    outliers: float = 0.0,
) -> GpsFixes:
    """Fixes once a second, with errors that follow each other, late by OFFSET_S."""
    rng = np.random.default_rng(seed)
    at = np.arange(0.5, 1e-9 * stamps[-1] - 0.5, 1.0)
    true = np.stack([np.interp(at + OFFSET_S, 1e-9 * stamps, column) for column in enu.T], axis=1)
    errors = np.zeros_like(true)
    for row in range(len(at)):
        new = rng.normal(size=3) * [1.0, 1.0, 2.0] * noise_m
        errors[row] = new if row == 0 else (
            correlation * errors[row - 1] + np.sqrt(1 - correlation**2) * new
        )  # fmt: skip
    wrong = rng.random(len(at)) < outliers
    errors[wrong] += rng.normal(0.0, 60.0, (int(wrong.sum()), 3))
    latitude, longitude, altitude = geodetic_of_enu(true + errors, ORIGIN)
    sigma = np.tile([1.0, 1.0, 2.0], (len(at), 1)) * noise_m
    return GpsFixes(
        stamps_ns=np.rint(1e9 * at).astype(np.int64),
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=altitude,
        sigma_m=sigma if said else np.full_like(sigma, np.nan),
    )


def in_map(enu: np.ndarray) -> np.ndarray:
    """Positions in the map: p_enu = SCALE TURN p_map + an offset."""
    return (enu - [100.0, -50.0, 7.0]) @ TURN / SCALE


def up_in_map() -> np.ndarray:
    return TURN.T @ [0.0, 0.0, 1.0]


def fitted(*arguments: object) -> GpsFit:
    found = fit_to_fixes(*arguments)  # type: ignore[arg-type]
    assert isinstance(found, GpsFit), found
    return found


@pytest.mark.parametrize("up", [None, up_in_map()], ids=["free", "gravity"])
def test_exact_fixes_give_the_exact_place(up: np.ndarray | None) -> None:
    stamps, enu = path(90.0)
    found = fitted(stamps, in_map(enu), measured(stamps, enu, seed=0, noise_m=1e-6), up)
    assert found.metres_per_unit == pytest.approx(SCALE, rel=1e-5)
    assert found.offset_s == pytest.approx(OFFSET_S, abs=1e-3)
    placed = found.metres_per_unit * in_map(enu) @ found.R_enu_world.T + found.p_enu_world
    ours = geodetic_of_enu(placed, found.origin)
    for mine, true in zip(ours, geodetic_of_enu(enu, ORIGIN), strict=True):
        assert mine == pytest.approx(true, abs=1e-2)


@pytest.mark.parametrize("correlation", [0.0, 0.8])
@pytest.mark.parametrize("said", [False, True])
def test_sigmas_are_those_of_the_errors(said: bool, correlation: float) -> None:
    stamps, enu = path(120.0)
    runs = [
        fitted(
            stamps,
            in_map(enu),
            measured(stamps, enu, seed=seed, noise_m=1.5, said=said, correlation=correlation),
        )
        for seed in range(30)
    ]
    off = np.array([np.log(run.metres_per_unit / SCALE) / run.scale_sigma for run in runs])
    late = np.array([(run.offset_s - OFFSET_S) / run.offset_sigma_s for run in runs])
    for errors in (off, late):  # in sigmas
        assert 0.5 < np.sqrt(np.mean(errors**2)) < 1.6
    assert max(run.scale_sigma for run in runs) < 0.05


def test_wrong_fixes_weigh_little() -> None:
    stamps, enu = path(120.0)
    clean = fitted(stamps, in_map(enu), measured(stamps, enu, seed=3))
    found = fitted(stamps, in_map(enu), measured(stamps, enu, seed=3, outliers=0.25))
    assert abs(np.log(found.metres_per_unit / SCALE)) < 0.03
    assert found.agreeing < 0.85 * found.fixes
    assert clean.agreeing > 0.9 * clean.fixes


def test_fixes_of_another_place_are_refused() -> None:
    stamps, enu = path(120.0)
    rng = np.random.default_rng(5)
    other = rng.permutation(len(measured(stamps, enu, seed=0).stamps_ns))
    fixes = measured(stamps, enu, seed=0)
    mixed = replace(fixes, latitude_deg=fixes.latitude_deg[other])
    assert isinstance(fit_to_fixes(stamps, in_map(enu), mixed), GpsRefusal)


def test_too_short_a_path_is_refused() -> None:
    stamps, enu = path(20.0)
    found = fit_to_fixes(stamps, in_map(0.05 * enu), measured(stamps, 0.05 * enu, seed=1))
    assert isinstance(found, GpsRefusal)
    assert "too short" in found.reason or "agree" in found.reason


def test_straight_path_needs_gravity() -> None:
    stamps, enu = path(60.0, straight=True)
    fixes = measured(stamps, enu, seed=2, noise_m=0.5)
    alone = fit_to_fixes(stamps, in_map(enu), fixes)
    assert isinstance(alone, GpsRefusal)
    assert "too straight" in alone.reason
    scale = fit_to_fixes(stamps, in_map(enu), fixes, oriented=False)
    assert isinstance(scale, GpsFit)
    assert scale.metres_per_unit == pytest.approx(SCALE, rel=0.03)
    found = fitted(stamps, in_map(enu), fixes, up_in_map())
    assert found.metres_per_unit == pytest.approx(SCALE, rel=0.03)
    assert found.R_enu_world @ up_in_map() == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)


def test_without_altitudes_gravity_is_needed() -> None:
    stamps, enu = path(120.0)
    fixes = measured(stamps, enu, seed=4)
    sigma = fixes.sigma_m.copy()
    sigma[:, 2] = np.inf
    flat = replace(fixes, altitude_m=np.zeros_like(fixes.altitude_m), sigma_m=sigma)
    found = fitted(stamps, in_map(enu), flat, up_in_map())
    assert found.metres_per_unit == pytest.approx(SCALE, rel=0.02)
    assert isinstance(fit_to_fixes(stamps, in_map(enu), flat), GpsRefusal)


@pytest.mark.parametrize("count", [0, 1, 5])
def test_few_fixes_or_poses_are_refused(count: int) -> None:
    stamps, enu = path(60.0)
    fixes = measured(stamps, enu, seed=0)
    few = GpsFixes(**{name: value[:count] for name, value in vars(fixes).items()})
    assert isinstance(fit_to_fixes(stamps, in_map(enu), few), GpsRefusal)
    assert isinstance(fit_to_fixes(stamps[:1], in_map(enu)[:1], fixes), GpsRefusal)
    still = np.zeros_like(enu)
    assert isinstance(fit_to_fixes(stamps, still, fixes), GpsRefusal)


@pytest.mark.parametrize("with_gravity", [False, True])
def test_jacobian_by_finite_differences(with_gravity: bool) -> None:
    rng = np.random.default_rng(0)
    times = np.arange(0.0, 30.0, 0.1)
    # Positions are quadratic between the frames, so that interpolation has the derivative.
    positions = np.outer(times, [0.5, 0.2, -0.1])
    problem = Problem(
        fixes=rng.normal(0.0, 10.0, (20, 3)),
        inverse_sigma=np.ones((20, 3)),
        stamps_s=np.linspace(3.03, 25.03, 20),
        times_s=times,
        positions=positions,
        velocities=np.gradient(positions, times, axis=0),
        R_up=np.eye(3) if with_gravity else None,
    )

    def state() -> State:
        return State(0.3, so3_exp(np.array([0.2, 0.4, -0.3])), np.array([1.0, 2.0, 3.0]), 0.1)

    _, J = linearised(problem, state())
    assert J.shape[2] == (6 if with_gravity else 8)
    for column in range(J.shape[2]):
        sides = []
        for sign in (1.0, -1.0):
            moved = state()
            step = np.zeros(J.shape[2])
            step[column] = sign * 1e-6
            moved_by(problem, moved, step)
            sides.append(linearised(problem, moved)[0])
        assert J[:, :, column] == pytest.approx((sides[0] - sides[1]) / 2e-6, abs=1e-6)
