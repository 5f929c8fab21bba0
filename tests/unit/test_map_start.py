"""How a map starts: the motion of two views, when it waits, and how far back it reaches."""

import re
from dataclasses import replace

import numpy as np
import pytest
from mapping_scene import INTERVAL_NS

from pliant.algorithms.arrays import F64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration, widened
from pliant.algorithms.slam.estimate.epipolar import RelativePose
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.start import start as start_of_a_map
from pliant.algorithms.slam.start.backfill import backfill
from pliant.algorithms.slam.start.first_map import BufferedFrame, Start
from pliant.algorithms.slam.start.focal_hypotheses import find_start_of
from pliant.algorithms.slam.start.start import find_start, with_minimum_parallax

CAMERA = PinholeCamera(fx=400.0, fy=400.0, cx=320.0, cy=240.0, width=640, height=480)


def frame_of(
    frame: int, points: F64, centre: F64, alive: BoolArray, noise_px: float
) -> BufferedFrame:
    """What a camera at ``centre`` that looks along z sees of the points with living tracks."""
    seen = points - centre
    px = CAMERA.project(seen) + np.random.default_rng(frame).normal(0.0, noise_px, (len(seen), 2))
    inside = ((px > 0.0) & (px < (CAMERA.width, CAMERA.height))).all(axis=1)
    ids = np.flatnonzero(inside & alive)
    return BufferedFrame(
        frame=frame,
        stamp_ns=frame * INTERVAL_NS,
        ids=ids,
        points_px=px[ids].astype(np.float32),
        kappas=(0.5 * ids).astype(np.float32),
    )


def ride(frames: int, step_m: float, life: int) -> tuple[F64, list[BufferedFrame]]:
    """A camera that looks at a wall and goes along it; its tracks live for so many frames.

    Returns where it was (F, 3), and the frames.
    """
    random = np.random.default_rng(0)
    points = random.uniform((-4.0, -1.5, 2.5), (4.0, 1.5, 4.0), (12_000, 3))
    born = random.integers(-life, frames, len(points))
    centres = np.arange(frames)[:, None] * np.array([step_m, 0.0, 0.0])
    waiting = [
        frame_of(k, points, centres[k], (born <= k) & (k < born + life), 0.1) for k in range(frames)
    ]
    return centres.astype(np.float64), waiting


def started(waiting: list[BufferedFrame]) -> Start:
    start = find_start(waiting, CAMERA, MappingParameters())
    assert isinstance(start, Start), start
    return start


@pytest.mark.parametrize("focal_px", [40.0, 400.0])
@pytest.mark.parametrize("noise_px", [1.2, 1.6])
def test_what_is_too_little_is_less_than_enough(focal_px: float, noise_px: float) -> None:
    """A wide lens makes degrees of a pixel: the reason has the unit of what was decided by."""
    random = np.random.default_rng(0)
    camera = PinholeCamera(fx=focal_px, fy=focal_px, cx=320.0, cy=240.0, width=640, height=480)
    points = random.uniform((20, 20), (620, 460), (300, 2))
    waiting = [
        BufferedFrame(
            frame=frame,
            stamp_ns=frame * INTERVAL_NS,
            ids=np.arange(300),
            points_px=(points + random.normal(0.0, noise_px / 2, points.shape)).astype(np.float32),
            kappas=np.ones(300, np.float32),
        )
        for frame in range(6)
    ]
    reason = find_start(waiting, camera, MappingParameters())
    assert isinstance(reason, str)
    unit = "(px without the rotation|deg)"
    told = re.fullmatch(rf"too little parallax: (\S+) of (\S+) {unit}", reason)
    assert told, reason
    assert float(told[1]) < float(told[2])


@pytest.mark.parametrize(
    ("speed", "frames", "parameters"),
    [(1.0, 8, with_minimum_parallax(MappingParameters())), (0.5, 20, MappingParameters())],
)
@pytest.mark.parametrize("seed", range(8))
def test_a_floor_at_the_border_never_starts_with_the_wrong_motion(
    speed: float, frames: int, parameters: MappingParameters, seed: int
) -> None:
    """Of what two views share all but a few points lie in one plane, in a corner of the image: two
    motions explain the plane.  A start has the true one, or waits."""
    random = np.random.default_rng(seed)
    camera = PinholeCamera(fx=320.0, fy=320.0, cx=320.0, cy=240.0, width=640, height=480)
    floor = np.column_stack(
        [random.uniform(3.0, 9.0, 400), np.full(400, 1.5), random.uniform(4.0, 10.0, 400)]
    )
    wall = random.uniform((-0.5, -0.8, 1.6), (0.9, 0.8, 2.0), (12, 3))
    points = np.concatenate([floor, wall])
    way = speed * np.array([-0.06, 0.02, 0.12])
    waiting: list[BufferedFrame] = []
    reason = ""
    for frame in range(frames):
        seen = points - frame * way
        px = seen[:, :2] / seen[:, 2:] * camera.fx + (camera.cx, camera.cy)
        px += random.normal(0.0, 0.15, px.shape)
        # Half of the wall's tracks slide along its joints.
        px[-6:, 0] += 6.0 * speed * frame
        inside = ((px > 0.0) & (px < (camera.width, camera.height))).all(axis=1)
        ids = np.flatnonzero(inside)
        waiting.append(
            BufferedFrame(
                frame=frame,
                stamp_ns=frame * INTERVAL_NS,
                ids=ids,
                points_px=px[ids].astype(np.float32),
                kappas=np.ones(len(ids), np.float32),
            )
        )
        start = find_start(waiting, camera, parameters)
        if not isinstance(start, str):
            moved = start.T_world_camera[-1, :3, 3]
            cosine = moved @ way / np.linalg.norm(moved) / np.linalg.norm(way)
            assert np.degrees(np.arccos(min(cosine, 1.0))) < 10.0
            return
        reason = start
    raise AssertionError(reason)


@pytest.mark.parametrize("total_m", [0.1, 0.4])
def test_it_waits_for_more_parallax_but_not_for_long(total_m: float) -> None:
    """Of 1.7 degrees and no more one is enough in the end; 7 degrees are there before."""
    parameters = MappingParameters()
    patient = round(1e9 * parameters.start.patient_s / INTERVAL_NS)
    _, waiting = ride(patient + 2, total_m / patient, life=1000)
    found = [
        not isinstance(find_start(waiting[:k], CAMERA, parameters), str)
        for k in range(2, len(waiting) + 1)
    ]
    assert found[-1]
    first = 1 + found.index(True)
    assert (first >= patient) == (total_m < 0.2)


def test_a_camera_that_has_hardly_moved_is_rejected_quickly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All tracks are compared once it has moved: that takes ten times as long."""
    compared: list[int] = []
    closely = start_of_a_map.relative_poses

    def count(*points: F64, gate: float) -> list[RelativePose]:
        compared.append(len(points[0]))
        return closely(*points, gate=gate)

    monkeypatch.setattr(start_of_a_map, "relative_poses", count)
    _, waiting = ride(14, 0.02, life=1000)
    reason = find_start(waiting[:7], CAMERA, MappingParameters())
    assert re.fullmatch(r"too little parallax: [01]\.\d\d of 3\.00 deg", str(reason))
    assert not compared
    started(waiting)
    assert compared


def test_under_a_guessed_focal_length_it_does_not_wait() -> None:
    """The farther the camera has moved, the fewer tracks agree with a wrong one."""
    _, waiting = ride(8, 0.023, life=1000)
    assert str(find_start(waiting, CAMERA, MappingParameters())).startswith("too little parallax")
    guess = widened(MappingParameters(), 0.3)
    known = SelfCalibration.of(CAMERA, guess.calibration)
    assert not isinstance(find_start_of(waiting, known, guess), str)


def street(frames: int) -> list[BufferedFrame]:
    """A walk straight ahead towards what is far, beside what is near and leaves the image soon."""
    random = np.random.default_rng(0)
    near = random.uniform((-6.0, -3.0, 4.0), (6.0, 3.0, 24.0), (4000, 3))
    near = near[np.abs(near[:, 0]) > 2.0]
    far = random.uniform((-80.0, -20.0, 50.0), (80.0, 20.0, 120.0), (4000, 3))
    points = np.concatenate([near, far])
    born = random.integers(-60, frames, len(points))
    centres = np.arange(frames)[:, None] * np.array([0.0, 0.0, 0.045])
    return [
        frame_of(k, points, centres[k], (born <= k) & (k < born + 60), 0.2) for k in range(frames)
    ]


@pytest.mark.parametrize("sigma", [0.0, 0.4])
def test_straight_ahead_a_quarter_of_the_tracks_is_enough_after_a_while(sigma: float) -> None:
    """What is near leaves the image first, so that most of what two views share is always far."""
    parameters = widened(MappingParameters(), sigma)
    known = SelfCalibration.of(CAMERA, parameters.calibration)
    long = round(1e9 * parameters.start.long_s / INTERVAL_NS)
    waiting = street(long + 2)
    assert "too little parallax" in str(find_start_of(waiting[: long - 2], known, parameters))
    found = find_start_of(waiting, known, parameters)
    assert not isinstance(found, str), found


def test_tracks_that_end_too_soon_are_no_turn() -> None:
    """At few images a second most live for two frames; from one to the next each motion is like a
    turn, and no map begins with so few."""
    random = np.random.default_rng(0)
    points = random.uniform((-4.0, -2.0, 8.0), (4.0, 2.0, 8.2), (4000, 3))
    waiting = [
        frame_of(k, points, 0.6 * k * np.eye(3)[0], np.arange(len(points)) % 12 // 2 == k // 2, 0.1)
        for k in range(12)
    ]
    seconds = [replace(each, stamp_ns=round(each.frame * 1e9)) for each in waiting]
    assert find_start(seconds, CAMERA, MappingParameters()) == (
        "too few tracks: 0 of 100 last for 3 frames"
    )


def test_among_many_frames_the_one_before_the_last_is_tried() -> None:
    """Tracks that live for three frames are enough, however many frames wait."""
    random = np.random.default_rng(0)
    points = random.uniform((-6.0, -2.0, 3.0), (6.0, 2.0, 8.0), (6000, 3))
    born = random.integers(0, 10, len(points))
    waiting = [
        frame_of(k, points, 0.15 * k * np.eye(3)[0], (born <= k) & (k < born + 3), 0.1)
        for k in range(12)
    ]
    seconds = [replace(each, stamp_ns=round(each.frame * 1e9)) for each in waiting]
    started(seconds)


def test_it_reaches_back_to_frames_whose_tracks_have_ended() -> None:
    centres, waiting = ride(24, 0.06, life=8)
    start = started(waiting[-8:])
    assert len(np.intersect1d(waiting[0].ids, start.ids)) == 0
    reached = backfill(start, waiting, CAMERA, MappingParameters())
    assert reached.frames[0] == 0
    assert reached.frames[-1] == start.frames[-1]
    moved = reached.T_world_camera[:, :3, 3] - reached.T_world_camera[0, :3, 3]
    scale = moved[-1, 0] / centres[-1, 0]
    np.testing.assert_allclose(moved / scale, centres[reached.frames], atol=0.02)
    np.testing.assert_allclose(reached.T_world_camera[0], np.eye(4), atol=1e-12)
    assert len(np.intersect1d(waiting[0].ids, reached.ids)) > 100
    np.testing.assert_array_equal(reached.kappas, 0.5 * reached.ids)
    assert (reached.newest_px >= 0.0).all()
    assert (reached.newest_px <= (CAMERA.width - 1, CAMERA.height - 1)).all()


def test_it_reaches_back_over_many_lives_of_tracks() -> None:
    centres, waiting = ride(120, 0.03, life=8)
    start = find_start(waiting[-8:], CAMERA, with_minimum_parallax(MappingParameters()))
    assert isinstance(start, Start), start
    reached = backfill(start, waiting, CAMERA, MappingParameters())
    assert reached.frames[0] == 0
    moved = reached.T_world_camera[:, :3, 3]
    np.testing.assert_allclose(
        moved * centres[-1, 0] / moved[-1, 0], centres[reached.frames], atol=0.02
    )


def test_it_reaches_no_further_than_tracks_lead() -> None:
    _, waiting = ride(24, 0.06, life=8)
    start = started(waiting[-8:])
    for broken in (2, 15):
        dark = replace(waiting[broken], ids=waiting[broken].ids[:0])
        cut = [dark if each.frame == broken else each for each in waiting]
        reached = backfill(start, cut, CAMERA, MappingParameters())
        assert reached.frames[0] == broken + 1
