"""Pictures, videos and animations: sizes, colours where they must be, and clear errors."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pliant.algorithms.tracks import COASTING, FrameTracks
from pliant.errors import ResultError
from pliant.pictures.map import choose_view, height_colours, render_map, write_map_picture
from pliant.pictures.movie import beside, write_animation, write_image, write_movie
from pliant.pictures.overlay import (
    OverlayFrame,
    TrackPainter,
    write_overlay_picture,
    write_overlay_video,
)


def frame(number: int, *, count: int = 30, width: int = 64, height: int = 48) -> OverlayFrame:
    rng = np.random.default_rng(1)
    points = rng.uniform((5, 5), (width - 5, height - 5), (count, 2)) + np.array(
        [0.4 * number, 0.0]
    )
    tracks = FrameTracks(
        ids=np.arange(count, dtype=np.int64),
        points_px=points.astype(np.float32),
        ages=np.full(count, number, np.int32),
        kappas=np.ones(count, np.float32),
        states=(np.arange(count) % 2 * COASTING).astype(np.uint8),
        maxima=np.zeros((0, 3), np.float32),
        dominant_flow=np.eye(2, 3),
    )
    image = np.full((height, width), 100, np.uint8)
    return OverlayFrame(
        image=image, tracks=tracks, number=number, status="tracking", mapped_ids=tracks.ids[::3]
    )


def test_a_track_is_drawn_where_it_is() -> None:
    one = frame(0, count=1)
    tracks = FrameTracks(**{**vars(one.tracks), "points_px": np.array([[20.0, 30.0]], np.float32)})
    picture = TrackPainter(scale=3).draw(OverlayFrame(image=one.image, tracks=tracks, number=0))
    assert picture.shape == (48 * 3 + 30, 64 * 3, 3)
    coloured = np.ptp(picture[: 48 * 3].astype(int), axis=2) > 30
    rows, columns = np.nonzero(coloured)
    # Pixel (20, 30) of the image is centred on (61, 91) of one three times as large.
    assert (columns.mean(), rows.mean()) == (pytest.approx(61, abs=0.3), pytest.approx(91, abs=0.3))


def test_tails_follow_and_drawing_is_deterministic() -> None:
    pictures = []
    for _ in range(2):
        painter = TrackPainter()
        pictures.append([painter.draw(frame(number)) for number in range(8)])
    assert all(np.array_equal(a, b) for a, b in zip(*pictures, strict=True))
    without_tails = TrackPainter().draw(frame(7))
    assert not np.array_equal(pictures[0][7], without_tails)


def test_frames_without_tracks_and_new_ids() -> None:
    painter = TrackPainter()
    first = painter.draw(frame(0))
    empty = OverlayFrame(image=frame(0).image, tracks=FrameTracks.empty(), number=1)
    assert painter.draw(empty).shape == first.shape
    assert painter.draw(frame(2)).shape == first.shape
    colour = OverlayFrame(
        image=np.full((48, 64, 3), 90, np.uint8), tracks=FrameTracks.empty(), number=3
    )
    assert painter.draw(colour).shape == first.shape


@pytest.mark.parametrize("suffix", [".mp4", ".avi"])
def test_video_can_be_read_again(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"v{suffix}"
    assert write_overlay_video(file, (frame(i) for i in range(5)), fps=30.0) == 5
    capture = cv2.VideoCapture(str(file))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(30.0)
    count = 0
    while capture.read()[0]:
        count += 1
    capture.release()
    assert count == 5


def test_video_errors_are_clear(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match=r"use \.mp4 or \.avi"):
        write_overlay_video(tmp_path / "v.mov", [frame(0)], fps=30.0)
    with pytest.raises(ResultError, match="no frames"):
        write_overlay_video(tmp_path / "v.mp4", [], fps=30.0)
    with pytest.raises(ResultError, match="cannot be written"):
        write_overlay_video(tmp_path / "no" / "v.mp4", [frame(0)], fps=30.0)
    sizes = [np.zeros((48, 64, 3), np.uint8), np.zeros((48, 66, 3), np.uint8)]
    with pytest.raises(ResultError, match="another size"):
        write_movie(tmp_path / "v.mp4", sizes, fps=30.0)


def test_images(tmp_path: Path) -> None:
    red = np.zeros((8, 8, 3), np.uint8)
    red[:, :, 0] = 255
    write_image(tmp_path / "a.png", red)
    assert cv2.imread(str(tmp_path / "a.png"))[0, 0].tolist() == [0, 0, 255]
    with pytest.raises(ResultError, match="unknown kind of image"):
        write_image(tmp_path / "a.xyz", red)
    write_overlay_picture(tmp_path / "o.png", frame(0))
    assert cv2.imread(str(tmp_path / "o.png")).shape == (126, 128, 3)


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_animation(tmp_path: Path, suffix: str) -> None:
    if not hasattr(cv2, "imencodeanimation"):
        pytest.skip("this OpenCV is older than 4.11")
    painter = TrackPainter()
    pictures = [beside(painter.draw(frame(i)), np.zeros((60, 80, 3), np.uint8)) for i in range(3)]
    file = tmp_path / f"a{suffix}"
    write_animation(file, pictures, fps=10.0, width=96)
    good, animation = cv2.imreadanimation(str(file))
    assert good
    assert len(animation.frames) == 3
    assert animation.frames[0].shape[1] == 96
    with pytest.raises(ResultError, match="unknown kind of animation"):
        write_animation(tmp_path / "a.mng", pictures, fps=10.0)
    with pytest.raises(ResultError, match="no frames"):
        write_animation(file, [], fps=10.0)


def scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A floor (y down) in front of a camera that moves forward."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-2, 1, 1), (2, 1.01, 6), (4000, 3))
    T = np.tile(np.eye(4), (10, 1, 1))
    T[:, 2, 3] = np.linspace(0, 2, 10)
    return points, np.full((4000, 3), 200, np.uint8), T


def test_map_is_seen_from_above_and_behind(tmp_path: Path) -> None:
    points, colours, T = scene()
    view = choose_view(points, T)
    assert np.allclose(view.up, (0.0, -1.0, 0.0))
    assert np.linalg.det(view.T_world_view[:3, :3]) == pytest.approx(1.0)
    eye = view.T_world_view[:3, 3]
    assert eye[1] < 0.0
    assert eye[2] < 0.0
    picture = render_map(points, colours, T, view=view, size=(160, 120))
    assert picture.shape == (120, 160, 3)
    assert np.array_equal(picture, render_map(points, colours, T, view=view, size=(160, 120)))
    assert (picture.astype(int).sum(axis=2) > 200).mean() > 0.1
    write_map_picture(tmp_path / "m.png", points, colours, T, size=(80, 60))
    assert cv2.imread(str(tmp_path / "m.png")).shape == (60, 80, 3)


def test_nearer_points_hide_farther_ones() -> None:
    _, _, T = scene()
    view = replace(choose_view(scene()[0], T), ceiling=np.inf)
    eye, direction = view.T_world_view[:3, 3], view.T_world_view[:3, 2]
    distances = 0.3 * view.reach * np.array([1.0, 0.9, 1.1])
    points = eye + direction * distances[:, None]
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    picture = render_map(points, colours, T[:0], view=view, size=(80, 60), splat=6.0)
    assert picture[30, 40].argmax() == 1


def test_maps_of_nothing() -> None:
    _, _, T = scene()
    none, no_colours = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    view = choose_view(none, T[:1])
    assert render_map(none, no_colours, T[:1], view=view, size=(80, 60)).shape == (60, 80, 3)
    assert len(height_colours(none, no_colours, view.up)) == 0


def test_height_colours_keep_brightness() -> None:
    points, colours, _ = scene()
    points[:, 1] = np.linspace(0, 1, len(points))
    bright = height_colours(points, colours, np.array([0.0, -1.0, 0.0]))
    dark = height_colours(points, colours // 4, np.array([0.0, -1.0, 0.0]))
    assert bright.dtype == np.uint8
    assert np.all(bright.sum(axis=1, dtype=int) > dark.sum(axis=1, dtype=int))
    assert not np.array_equal(bright[0], bright[-1])
