"""Depth from a rectified stereo pair: of a rendered one exactly, of a real one beside its CT."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from running import write_sequence

from pliant.datasets import open_source
from pliant.datasets.depth import DepthRectifier
from pliant.datasets.source_spec import SourceSpec
from pliant.datasets.stereo import consistent_disparities
from pliant.errors import CalibrationError

LIVER = Path(__file__).parents[3] / "shared" / "data" / "deformable" / "opencas_liver_stereo"
WIDTH, HEIGHT, FOCAL, BASELINE = 160, 120, 150.0, 0.01
LENS = {"k1": 0.1, "k2": 0.0, "p1": 0.0, "p2": 0.0}


def texture(width: int) -> np.ndarray:
    random = np.random.default_rng(0)
    noise = random.integers(0, 256, (HEIGHT, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.2)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)  # type: ignore[call-overload]


def pair(near: int = 24, far: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """A near square before a far wall, at whole disparities."""
    wall = texture(WIDTH + 64)
    left, right = wall[:, :WIDTH].copy(), wall[:, far : WIDTH + far].copy()
    square = np.random.default_rng(1).permutation(wall[30:90, 60:110].ravel()).reshape(60, 50)
    square = cv2.GaussianBlur(square, (0, 0), 1.0)
    left[30:90, 80:130] = square
    right[30:90, 80 - near : 130 - near] = square
    return left, right


def test_disparities_of_two_surfaces_and_none_where_one_hides_the_other() -> None:
    found = consistent_disparities(*pair())
    square, wall = found[36:84, 86:124], found[5:25, 20:150]
    for area, expected in ((square, 24.0), (wall, 12.0)):
        known = area > 0.0
        assert known.mean() > 0.95
        assert (np.abs(area[known] - expected) < 0.25).mean() > 0.98
    # Seen by the left camera alone: to the left of the square.
    hidden = found[36:84, 70:78]
    assert (hidden == 0.0).mean() > 0.5


def folder_of(folder: Path, left: np.ndarray, right: np.ndarray, **calibration: object) -> Path:
    folder.mkdir(exist_ok=True)
    write_sequence(folder, [left, left], **calibration)
    cv2.imwrite(str(folder / "right.png"), right)
    (folder / "right.txt").write_text("0.000000 right.png\n")
    return folder


def test_surfels_are_given_metres(tmp_path: Path) -> None:
    made = {"fx": FOCAL, "fy": FOCAL, "cx": 79.5, "cy": 59.5, "stereo_baseline": BASELINE}
    source = open_source(
        SourceSpec(location=str(folder_of(tmp_path, *pair(), **made)), depth="first")
    )
    frames = list(source)
    assert [bool(frame.depth) for frame in frames] == [True, False]
    metres = DepthRectifier(source.calibration).rectify(0, frames[0].depth)
    assert np.median(metres[36:84, 86:124]) == pytest.approx(FOCAL * BASELINE / 24.0, rel=0.01)
    assert np.median(metres[5:25, 20:150]) == pytest.approx(FOCAL * BASELINE / 12.0, rel=0.01)


@pytest.mark.parametrize(
    ("calibration", "says"),
    [
        ({}, "no stereo_baseline"),
        ({"stereo_baseline": -1.0}, "must be positive"),
        ({"stereo_baseline": BASELINE, "model": "pinhole-radtan", **LENS}, "rectify both"),
    ],
)
def test_what_is_missing_is_named(
    tmp_path: Path, calibration: dict[str, object], says: str
) -> None:
    with pytest.raises(CalibrationError, match=says):
        open_source(
            SourceSpec(location=str(folder_of(tmp_path, *pair(), **calibration)), depth="first")
        )


def test_a_right_image_that_is_none_gives_no_depth(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, *pair(), stereo_baseline=BASELINE)
    (folder / "right.png").write_bytes(b"no image")
    assert [
        frame.depth for frame in open_source(SourceSpec(location=str(folder), depth="first"))
    ] == [b"", b""]


def test_real_tissue_is_where_ct_saw_it() -> None:
    """Liver before a stereo laparoscope; the CT surface is given in the left camera's frame."""
    if not LIVER.is_dir():
        pytest.skip("the stereo pair of the shared data is not here")
    calibration = json.loads((LIVER / "calib.json").read_text())
    size = calibration["width"], calibration["height"]
    K_left, K_right = np.array(calibration["K_left"]), np.array(calibration["K_right"])
    lens_left, lens_right = (np.array(calibration[k]) for k in ("dist_left", "dist_right"))
    T = np.array(calibration["T_right_left_mm"])
    R_left, R_right, P_left, P_right, *_ = cv2.stereoRectify(
        K_left, lens_left, K_right, lens_right, size, T[:3, :3], T[:3, 3:], alpha=0
    )
    rectified = []
    for name, K, lens, R, P in (
        ("left", K_left, lens_left, R_left, P_left),
        ("right", K_right, lens_right, R_right, P_right),
    ):
        grey = cv2.imread(str(LIVER / "images" / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        columns, rows = cv2.initUndistortRectifyMap(K, lens, R, P, size, cv2.CV_32FC1)
        rectified.append(cv2.remap(grey, columns, rows, cv2.INTER_LINEAR))
    disparities = consistent_disparities(rectified[0], rectified[1])
    points = np.loadtxt(LIVER / "ct_points.xyz")[:, :3] @ R_left.T
    seen = P_left[:2, :2] @ (points[:, :2] / points[:, 2:]).T + P_left[:2, 2:3]
    u, v = seen.round().astype(int)
    inside = (u >= 0) & (u < size[0]) & (v >= 0) & (v < size[1])
    found = disparities[v[inside], u[inside]]
    error = -P_right[0, 3] / found[found > 0.0] - points[inside][found > 0.0, 2]
    assert (found > 0.0).mean() > 0.5
    assert abs(np.median(error)) < 2.0  # mm, at 60 to 70 mm
