"""The tracker as a whole: correct on known motion, deterministic, and unharmed by bad frames."""

import numpy as np
import pytest
from moving_texture import HEIGHT, WIDTH, follow, motion, render

from pliant.algorithms.arrays import U8, check_arrays
from pliant.algorithms.tracking.maxima import maxima_of
from pliant.algorithms.tracking.parameters import TrackingParameters
from pliant.algorithms.tracking.tracker import ExtremaTracker


@pytest.fixture(scope="module")
def sequence() -> list[U8]:
    """Twelve frames of the known motion, with noise and a gain that wobbles by 10 %."""
    return [render(f, gain=1.0 + 0.1 * np.sin(f)) for f in range(12)]


def test_tracks_follow_the_known_motion(sequence: list[U8]) -> None:
    results = follow(sequence, TrackingParameters(max_tracks=3000))
    last = results[-1]
    old = last.ages >= 10
    assert old.sum() > 100
    start = results[1]
    at = np.searchsorted(start.ids, last.ids[old])
    known = start.ids[np.minimum(at, len(start.ids) - 1)] == last.ids[old]
    M0, M1 = motion(1), motion(11)
    origin = (start.points_px[at[known]] - M0[:, 2]) @ np.linalg.inv(M0[:, :2]).T
    truth = origin @ M1[:, :2].T + M1[:, 2]
    error = np.linalg.norm(last.points_px[old][known] - truth, axis=1)
    assert (error < 2.0).mean() > 0.99


def test_every_frame_keeps_the_contract(sequence: list[U8]) -> None:
    for result in follow(sequence[:4], TrackingParameters(max_tracks=1000)):
        check_arrays(result)
        assert np.all(np.diff(result.ids) > 0)
        assert len(result.ids) <= 1000
        assert np.all((result.points_px >= 0) & (result.points_px < [WIDTH, HEIGHT]))


def test_same_input_gives_the_same_bytes(sequence: list[U8]) -> None:
    first = follow(sequence[:5], TrackingParameters(), seed=4)
    second = follow(sequence[:5], TrackingParameters(), seed=4)
    for a, b in zip(first, second, strict=True):
        for name in vars(a):
            assert getattr(a, name).tobytes() == getattr(b, name).tobytes()


@pytest.mark.parametrize("kind", ["black", "saturated", "noise", "bars", "dot", "switching"])
def test_hopeless_frames_do_no_harm(kind: str) -> None:
    rng = np.random.default_rng(0)
    images = []
    for frame in range(4):
        image = np.zeros((HEIGHT, WIDTH), np.uint8)
        if kind == "saturated" or (kind == "switching" and frame % 2):
            image[:] = 255
        elif kind == "noise":
            image = rng.integers(0, 256, image.shape, np.uint8)
        elif kind == "bars":
            image[:, ::7] = 200
        elif kind == "dot":
            image[100 + frame, 100] = 255
        images.append(image)
    for result in follow(images, TrackingParameters()):
        check_arrays(result)
        assert np.all(np.isfinite(result.points_px))


@pytest.mark.parametrize("shape", [(8, 8), (20, 30), (64, 17), (370, 1226)])
def test_any_size_of_image_will_do(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(1).integers(0, 256, shape, np.uint8)
    for result in follow([image, image], TrackingParameters()):
        check_arrays(result)


def test_an_image_of_another_size_is_refused() -> None:
    tracker = ExtremaTracker(WIDTH, HEIGHT, TrackingParameters())
    with pytest.raises(ValueError, match="uint8 image of shape"):
        tracker.track(np.zeros((HEIGHT, WIDTH + 1), np.uint8), 0)


def test_who_has_an_image_finds_the_maxima_that_the_tracker_found(sequence: list[U8]) -> None:
    """They are in no message: bundle adjustment makes them anew."""
    parameters = TrackingParameters(max_tracks=500)
    for image, tracks in zip(sequence[:3], follow(sequence[:3], parameters), strict=True):
        assert len(tracks.maxima) > 500
        assert maxima_of(image, parameters).tobytes() == tracks.maxima.tobytes()


def test_kappas_are_rounded_to_eight_bits(sequence: list[U8]) -> None:
    tracks = follow(sequence[:1], TrackingParameters(max_tracks=500))[0]
    assert not (tracks.kappas.view(np.uint32) & 0xFFFF).any()
    at = np.rint(tracks.points_px).astype(int)  # of tracks that begin: the maximum is theirs
    maxima = {(round(float(u)), round(float(v))): kappa for u, v, kappa in tracks.maxima}
    exact = np.array([maxima.get((u, v), np.nan) for u, v in at.tolist()])
    there = np.isfinite(exact)
    assert there.sum() > 0.9 * len(at)
    np.testing.assert_allclose(tracks.kappas[there], exact[there], rtol=2.0**-8)


@pytest.mark.parametrize(("fps", "frames"), [(5, 3), (30, 20), (60, 40)])
def test_tracks_coast_for_seconds_of_the_stream(fps: int, frames: int) -> None:
    bright, dim = (render(0, gain=gain, noise=0.0) for gain in (1.0, 0.4))
    # Curvature goes with the cube of the contrast: the patches stay, the extrema do not.
    strongest = float(np.abs(maxima_of(bright, TrackingParameters())[:, 2]).max())
    parameters = TrackingParameters(min_curvature=0.1 * strongest)
    first, *coasting, last = follow([bright, *[dim] * (frames + 1)], parameters, fps=fps)
    assert len(coasting) == frames
    assert all(len(tracks.ids) > 0.8 * len(first.ids) > 500 for tracks in coasting)
    assert len(last.ids) == 0
