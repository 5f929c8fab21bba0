"""Pictures, videos and animations: sizes, colours where they must be, and clear errors."""

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pliant.algorithms.arrays import F64
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.tracks import COASTING, FrameTracks
from pliant.errors import ResultError
from pliant.pictures.caption import with_caption
from pliant.pictures.map import BACKGROUND, FOCAL, MapView, choose_view, render_map, turned
from pliant.pictures.mesh import draw_mesh, mesh_view
from pliant.pictures.movie import beside, write_animation, write_image, write_movie
from pliant.pictures.overlay import (
    OverlayFrame,
    TrackPainter,
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
    assert picture.shape == (48 * 3 + 20, 64 * 3, 3)
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


def test_however_many_tracks_move_the_image_stays_visible() -> None:
    painter, rng = TrackPainter(scale=1), np.random.default_rng(3)
    picture = np.zeros((0, 0, 3), np.uint8)
    start = rng.uniform((0, 0), (320, 240), (20_000, 2))
    for number in range(12):
        some = frame(number, count=len(start), width=320, height=240)
        moved = (start + np.array([4.0, 2.0]) * number).astype(np.float32)
        tracks = replace(some.tracks, points_px=moved)
        picture = painter.paint(replace(some, tracks=tracks, mapped_ids=None))
    touched = np.ptp(picture.astype(int), axis=2) > 60
    assert 0.03 < touched.mean() < 0.25


def test_words_are_a_share_of_the_picture_and_never_leave_it() -> None:
    for height, width in ((480, 640), (960, 1280), (360, 960)):
        whole = with_caption(np.zeros((height, width, 3), np.uint8), "tracking")
        rows = np.flatnonzero((whole[height:, :, 0] > 120).any(axis=1))
        assert 0.035 * height < np.ptp(rows) < 0.07 * height
        assert not whole[:height].any()
    assert with_caption(np.zeros((33, 65, 3), np.uint8), "").shape[:2] == (54, 64)
    long = with_caption(np.zeros((90, 120, 3), np.uint8), "tracking " * 30)
    assert (long[90:, -4:] < 40).all()
    assert (long[90:] > 60).any()


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


@pytest.mark.parametrize("suffix", [".webm", ".mp4", ".avi"])
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


def test_browsers_play_a_video(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """It is WebM, whatever its name has in it; nothing is written to the terminal, or beside it."""
    file = tmp_path / "12:30 %03d.webm"
    write_overlay_video(file, (frame(i) for i in range(5)), fps=30.0)
    head = file.read_bytes()[:64]
    assert head.startswith(b"\x1a\x45\xdf\xa3")
    assert b"\x42\x82\x84webm" in head
    assert b"V_VP8" in file.read_bytes()
    assert capfd.readouterr().err == ""
    assert list(tmp_path.iterdir()) == [file]


def test_a_video_that_fails_leaves_the_one_before(tmp_path: Path) -> None:
    file = tmp_path / "v.webm"
    write_overlay_video(file, [frame(0)], fps=30.0)
    before = file.read_bytes()
    with pytest.raises(ResultError, match="no frames"):
        write_overlay_video(file, [], fps=30.0)
    assert file.read_bytes() == before
    assert list(tmp_path.iterdir()) == [file]
    with pytest.raises(ResultError, match="a name is not UTF-8"):
        write_overlay_video(tmp_path / os.fsdecode(b"caf\xe9.webm"), [frame(0)], fps=30.0)


def test_video_errors_are_clear(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match=r"use \.webm, \.mp4, \.avi"):
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
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    write_image(tmp_path / "n.webp", noise)
    assert (tmp_path / "n.webp").stat().st_size < 0.9 * noise.size  # it is not lossless
    assert TrackPainter().draw(frame(0)).shape == (116, 128, 3)


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_animation(tmp_path: Path, suffix: str) -> None:
    if not hasattr(cv2, "imencodeanimation"):
        pytest.skip("this OpenCV is older than 4.11")
    painter = TrackPainter()
    drawn = [painter.draw(frame(i)) for i in range(3)]
    pictures = [beside(picture, np.zeros_like(picture)) for picture in drawn]
    file = tmp_path / f"a{suffix}"
    write_animation(file, pictures, fps=10.0)
    good, animation = cv2.imreadanimation(str(file))
    assert good
    assert len(animation.frames) == 3
    assert animation.frames[0].shape[1] == 2 * 128 + 4
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


def test_map_is_seen_from_above_and_behind() -> None:
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
    assert (picture.astype(int).sum(axis=2) > 200).mean() > 0.05
    one_place = np.stack([T[0, :3, 3], T[-1, :3, 3]])[None]
    with_places = render_map(points, colours, T, view=view, size=(160, 120), places=one_place)
    changed = with_places[(with_places != picture).any(axis=2)].astype(int)
    assert len(changed) > 10
    assert (changed.argmax(axis=1) == 1).mean() > 0.8  # green


@pytest.mark.parametrize("aspect", [0.5, 4 / 3, 3.0])
def test_a_view_is_framed_on_what_there_is(aspect: float) -> None:
    points, _, T = scene()
    stray = np.concatenate([points, [[500.0, 0.0, 500.0], [-80.0, 1.0, 900.0]]])
    near, far = (choose_view(cloud, T, aspect=aspect) for cloud in (points, stray))
    np.testing.assert_allclose(near.T_world_view, far.T_world_view, atol=0.2)

    def half_widths(view: MapView) -> tuple[np.ndarray, np.ndarray]:
        """How far path and points reach, of the middle to the rim; across and down."""
        there = np.concatenate([points, T[:, :3, 3]])
        local = (there - view.T_world_view[:3, 3]) @ view.T_world_view[:3, :3]
        reached = np.abs(local[:, :2] / local[:, 2:]) * 2.0 * FOCAL / (aspect, 1.0)
        return np.quantile(reached, 0.75, axis=0), reached.max(axis=0)

    most, all_of_it = half_widths(near)
    assert (most < 0.95).all()
    assert all_of_it.max() > 0.85
    swung = choose_view(points, T, aspect=aspect, swing_deg=60.0)
    for angle in (-60.0, 0.0, 60.0):
        eye = turned(swung, angle)
        np.testing.assert_allclose(
            np.linalg.norm(eye.T_world_view[:3, 3] - eye.centre),
            np.linalg.norm(swung.T_world_view[:3, 3] - swung.centre),
        )
        assert (half_widths(eye)[0] < 1.0).all()


def test_nearer_points_hide_farther_ones() -> None:
    _, _, T = scene()
    view = replace(choose_view(scene()[0], T), ceiling=np.inf)
    eye, direction = view.T_world_view[:3, 3], view.T_world_view[:3, 2]
    distances = 0.3 * view.reach * np.array([1.0, 0.9, 1.1])
    points = eye + direction * distances[:, None]
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    picture = render_map(points, colours, T[:0], view=view, size=(80, 60), splat=0.1)
    assert picture[30, 40].argmax() == 1


def test_maps_of_nothing() -> None:
    _, _, T = scene()
    none, no_colours = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    view = choose_view(none, T[:1])
    assert render_map(none, no_colours, T[:1], view=view, size=(80, 60)).shape == (60, 80, 3)


def test_a_wall_before_the_eye_is_of_one_colour_from_edge_to_edge() -> None:
    """Whatever rows are drawn together, and from its front alone."""
    view = MapView(
        T_world_view=np.eye(4), centre=np.zeros(3), up=np.zeros(3), ceiling=np.inf, reach=10.0
    )
    wall = TriangleMesh(
        positions=np.array([[-9, -9, 3], [9, -9, 3], [-9, 9, 3], [9, 9, 3]], np.float32),
        normals=np.tile(np.array([0, 0, -1], np.float32), (4, 1)),
        colours=np.full((4, 3), (200, 100, 50), np.uint8),
        triangles=np.array([[0, 1, 2], [1, 2, 3]], np.int32),
    )
    drawn = draw_mesh(wall, view, size=(64, 51))
    for picture in (drawn.colours, drawn.shaded, drawn.normals):
        assert picture.shape == (51, 64, 3)
        assert (picture == picture[0, 0]).all()
    assert drawn.normals[0, 0].tolist() == [128, 128, 255]
    assert drawn.colours[0, 0] / drawn.colours[0, 0, 0] == pytest.approx([1, 0.5, 0.25], abs=0.01)
    assert np.ptp(drawn.shaded[0, 0]) == 0
    behind = draw_mesh(replace(wall, normals=-wall.normals), view, size=(64, 51))
    assert (behind.shaded == BACKGROUND).all()


def grid(corner: F64, one: F64, other: F64, normal: F64) -> TriangleMesh:
    """A parallelogram of 20 x 20 cells."""
    shares = np.linspace(0.0, 1.0, 21)
    a, b = (each.ravel()[:, None] for each in np.meshgrid(shares, shares))
    first = (np.arange(20)[:, None] * 21 + np.arange(20)).ravel()
    halves = [np.stack([first, first + k, first + 22], axis=1) for k in (1, 21)]
    return TriangleMesh(
        positions=(corner + a * one + b * other).astype(np.float32),
        normals=np.tile(normal, (441, 1)).astype(np.float32),
        colours=np.full((441, 3), 200, np.uint8),
        triangles=np.concatenate(halves).astype(np.int32),
    )


def filled(mesh: TriangleMesh, view: MapView) -> float:
    """The share of a picture that shows the mesh."""
    return float((draw_mesh(mesh, view, size=(160, 120)).colours != BACKGROUND).any(axis=2).mean())


def path(z: float) -> F64:
    """Cameras that look along z, y down."""
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, 0, 3], T[:, 2, 3] = np.linspace(-0.2, 0.2, 5), z
    return T


def test_a_mesh_is_viewed_from_its_front() -> None:
    x, y, z = np.eye(3)
    wall = grid(4.0 * z - y, 2.0 * z, 2.0 * y, -x)  # its back is to the usual view
    usual = choose_view(wall.positions.astype(float), path(0.0))
    assert filled(wall, usual) < 0.01
    assert filled(wall, mesh_view(wall, path(0.0))) > 0.3


def test_a_mesh_fills_the_picture_however_far_the_path_is() -> None:
    x, y, z = np.eye(3)
    floor = grid(y + 2.0 * z - 2.0 * x, 4.0 * x, 4.0 * z, -y)
    for away in (0.0, -20.0):
        assert filled(floor, mesh_view(floor, path(away))) > 0.35
    assert filled(floor, choose_view(floor.positions.astype(float), path(-20.0))) < 0.1


def test_a_mesh_without_triangles_has_a_view() -> None:
    x, y, z = np.eye(3)
    nothing = replace(grid(z, x, y, -z), triangles=np.zeros((0, 3), np.int32))
    assert np.isfinite(mesh_view(nothing, path(0.0)).T_world_view).all()
