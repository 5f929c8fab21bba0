"""The judge of surfels on videos: right and wrong are known where the test moves the image."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from benchmarks.tissue import first_frame_reference, judge, lucas_kanade, measure, outside


def film(count: int, step: tuple[float, float]) -> list[np.ndarray]:
    """A texture that moves by ``step`` px in each frame."""
    grey = np.random.default_rng(0).uniform(0, 255, (240, 320)).astype(np.float32)
    grey = cv2.normalize(cv2.GaussianBlur(grey, (0, 0), 2.0), np.zeros(0), 20, 230, cv2.NORM_MINMAX)
    moves = [np.array([[1, 0, k * step[0]], [0, 1, k * step[1]]]) for k in range(count)]
    return [cv2.warpAffine(grey, m, (320, 240)).astype(np.uint8) for m in moves]


def test_the_reference_follows_the_first_frame_without_drift() -> None:
    images = film(8, (2.3, -1.1))
    points = np.array([[100.0, 120.0], [160.0, 100.0], [200.0, 150.0], [90.0, 150.0]])
    flow, kept = lucas_kanade(images, points)
    kept[6][:2] = False  # those are found by their neighbours
    found = first_frame_reference(images, points, flow, kept, [7])
    for frame in (6, 7):
        exact = points + frame * np.array([2.3, -1.1])
        np.testing.assert_allclose(found[frame], exact, atol=0.1)


def test_where_the_surface_looks_otherwise_there_is_no_reference() -> None:
    images = film(4, (1.0, 0.0))
    points = np.array([[100.0, 120.0], [200.0, 150.0]])
    flow, kept = lucas_kanade(images, points)
    images[3][80:160, 60:150] = np.random.default_rng(1).integers(0, 255, (80, 90), np.uint8)
    found = first_frame_reference(images, points, flow, kept, [3])[3]
    assert np.isnan(found[0]).all()
    assert np.isfinite(found[1]).all()


def test_alive_right_and_wrong() -> None:
    truth = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [np.nan, np.nan]])
    where = np.array([[2.0, 0.0], [14.0, 0.0], [20.0, 0.0], [5.0, 5.0]])
    alive = np.array([True, True, False, True])
    assert judge(where, alive, truth) == pytest.approx((0.75, 1 / 3, 1 / 2))


def test_surfels_in_the_polygon_do_not_count() -> None:
    polygon = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    assert outside(np.array([[5.0, 5.0], [15.0, 5.0]]), polygon).tolist() == [False, True]
    assert outside(np.array([[5.0, 5.0]]), np.zeros((0, 2))).all()


def test_a_video_has_a_row_for_each_frame(tmp_path: Path) -> None:
    for number, image in enumerate(film(5, (1.5, 0.5))):
        cv2.imwrite(str(tmp_path / f"{number}.png"), image)
    said = list(measure(str(tmp_path), "3,4", "0,0,60,0,60,240,0,240", ["max_surfels=40"]))
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in said[1].splitlines()[2:]]
    assert [row[0] for row in rows] == ["3", "4"]
    for row in rows:
        assert float(row[1]) > 50.0
        assert float(row[2]) > 90.0
        assert float(row[3]) > 90.0
        assert float(row[4]) == 0.0
