"""Displacements of surfels from the tracks about them."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pliant.algorithms.surfels.prediction import predict
from pliant.algorithms.tracks import FrameTracks


def tracks(ids: np.ndarray, points: np.ndarray, flow: np.ndarray) -> FrameTracks:
    n = len(ids)
    return FrameTracks(
        ids=ids.astype(np.int64),
        points_px=points.astype(np.float32),
        ages=np.zeros(n, np.int32),
        kappas=np.zeros(n, np.float32),
        states=np.zeros(n, np.uint8),
        dominant_flow=flow,
    )


def slow(points: np.ndarray, start: np.ndarray, moves: np.ndarray, flow: np.ndarray) -> np.ndarray:
    found = points @ flow[:, :2].T + flow[:, 2] - points
    for row, point in enumerate(points):
        distance = np.linalg.norm(start - point, axis=1)
        near = np.argsort(distance, kind="stable")[:9]
        near = near[distance[near] <= 30.0]
        if len(near) >= 3:
            found[row] = np.median(moves[near], axis=0)
    return found


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 200))
def test_the_kernel_does_what_plain_numpy_does(seed: int, count: int) -> None:
    random = np.random.default_rng(seed)
    flow = np.eye(2, 3) + random.normal(0.0, 0.1, (2, 3))
    start = random.uniform(0.0, 200.0, (count, 2)).astype(np.float32)
    moves = random.normal(0.0, 5.0, (count, 2)).astype(np.float32)
    ids = np.sort(random.choice(1000, count, replace=False))
    lost = random.random(count) < 0.2
    before = tracks(ids, start, np.eye(2, 3))
    now = tracks(ids[~lost], (start + moves)[~lost], flow)
    points = random.uniform(0.0, 200.0, (20, 2)).astype(np.float32)
    kept = (start + moves)[~lost] - start[~lost]
    expected = slow(points.astype(np.float64), start[~lost], kept, flow)
    np.testing.assert_allclose(predict(points, before, now), expected, atol=1e-4)
