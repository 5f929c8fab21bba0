"""Deforming built-in sequences: their truth agrees with itself and with what the images show."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pliant.algorithms.geometry import inverse, transform
from pliant.datasets import builtin_deforming
from pliant.datasets.builtin import builtin_folder, is_deforming
from pliant.errors import DatasetError
from pliant.rendering.deforming_scenes import (
    DEFORMING,
    PaperOptions,
    StretchingOptions,
    deforming_scene,
    frame_numbers,
)
from pliant.rendering.film import CameraOptions
from pliant.rendering.paper_motion import KEY_EVERY_S, plate_weights, points_at
from pliant.rendering.sheet_render import SheetRenderer, look, look_at_pixels, paint_sheet
from pliant.rendering.sheets import DeformingScene, material_positions

CAMERA = CameraOptions(width=320, height=240, noise=0.0, exposure=0.0, blur=0.0)
PINHOLE = CAMERA.pinhole()
LATER_S = 0.5
REAL_TRACKS = (
    Path(__file__).parents[3] / "shared/data/deformable/kinect_paper_tracks/mdh_23frames_301pts.npz"
)


def made_up_tracks() -> np.ndarray:
    """Points of a sheet that bends without being stretched, metres."""
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-0.15, 0.15, (2, 120))
    u[:4], v[:4] = [-0.15, 0.15, -0.15, 0.15], [-0.15, -0.15, 0.15, 0.15]
    bends = [1e-6, 0.7, 1.4, 1.9, 2.2]
    shapes = [
        np.stack([np.sin(k * u) / k, v, 0.55 + (1.0 - np.cos(k * u)) / k], axis=1) for k in bends
    ]
    return np.array(shapes)


TRACKS = made_up_tracks()


@pytest.mark.parametrize("name", sorted(DEFORMING))
def test_the_texture_is_where_the_ground_truth_has_it(name: str) -> None:
    """Material points of the first image, followed by the truth, keep their grey values."""
    scene = deforming_scene(name, DEFORMING[name].options(), TRACKS)
    renderer = SheetRenderer(
        scene, [paint_sheet(scene, i) for i in range(len(scene.sheets))], CAMERA
    )
    first, later = renderer.frame(0, 0.0), renderer.frame(15, LATER_S)
    pixels = np.random.default_rng(1).uniform((5.0, 5.0), (314.0, 234.0), (4000, 2))
    before = [sheet.shape(0.0) for sheet in scene.sheets]
    after = [sheet.shape(LATER_S) for sheet in scene.sheets]
    sheets, where, depth = look_at_pixels(before, first.T_world_camera, PINHOLE, pixels)
    near = (sheets >= 0) & (depth < scene.reach_m)
    sheets, where, pixels, depth = sheets[near], where[near], pixels[near], depth[near]
    assert len(pixels) > 400
    # The point is where it was picked, at the depth that was seen there.
    at_first, at_later = np.zeros((len(pixels), 3)), np.zeros((len(pixels), 3))
    for k in range(len(scene.sheets)):
        mine = sheets == k
        at_first[mine] = material_positions(before[k], where[mine])
        at_later[mine] = material_positions(after[k], where[mine])
    in_camera = transform(inverse(first.T_world_camera), at_first)
    np.testing.assert_allclose(PINHOLE.project(in_camera), pixels, atol=1e-6)
    np.testing.assert_allclose(in_camera[:, 2], depth, rtol=1e-9)
    # Where the later image still shows it, it looks the same.
    in_camera = transform(inverse(later.T_world_camera), at_later)
    moved = PINHOLE.project(in_camera)
    far = np.linalg.norm(moved - pixels, axis=1) > 1.5
    assert far.mean() > 0.1
    _, _, nearest = look_at_pixels(after, later.T_world_camera, PINHOLE, moved)
    inside = ((moved > 1.0) & (moved < (318.0, 238.0))).all(axis=1)
    seen = inside & (np.abs(nearest - in_camera[:, 2]) < 1e-6)
    assert seen.mean() > 0.7
    chosen = seen & far
    shown = later.image.astype(np.float32)
    images: list[Any] = [first.image.astype(np.float32), shown, *np.gradient(shown)]
    grey, there, down, right = (
        cv2.remap(
            image,
            np.ascontiguousarray(at[chosen, 0], np.float32)[:, None],
            np.ascontiguousarray(at[chosen, 1], np.float32)[:, None],
            cv2.INTER_LINEAR,
        )[:, 0]
        for image, at in zip(images, (pixels, moved, moved, moved), strict=True)
    )
    assert np.corrcoef(grey, there)[0, 1] > 0.9
    # A shift by which the later image is off would show along its gradient.
    columns = np.stack([right, down, np.ones_like(grey), there], axis=1)
    off = np.linalg.lstsq(columns, grey - there, rcond=None)[0][:2]
    assert np.abs(off).max() < 0.1


def test_the_depth_map_is_that_of_the_surface_within_reach() -> None:
    scene = deforming_scene("objects", DEFORMING["objects"].options())
    textures = [paint_sheet(scene, i) for i in range(len(scene.sheets))]
    frame = SheetRenderer(scene, textures, CAMERA).frame(9, 0.3)
    sheets = [sheet.shape(0.3) for sheet in scene.sheets]
    sight = look(sheets, frame.T_world_camera, PINHOLE)
    wall = sight.sheet == len(sheets) - 1
    assert np.isin(np.arange(len(sheets)), sight.sheet).all()
    assert (frame.depth_m[wall] == 0.0).all()
    rows, columns = np.nonzero(~wall)
    pixels = np.stack([columns, rows], axis=1).astype(np.float64)
    _, where, depth = look_at_pixels(sheets, frame.T_world_camera, PINHOLE, pixels[::37])
    np.testing.assert_allclose(frame.depth_m[rows, columns][::37], depth, rtol=1e-12)
    np.testing.assert_allclose(sight.where[rows, columns][::37], where, atol=1e-5)


@pytest.mark.parametrize(
    ("held", "poisson", "across"), [(False, 0.0, 1.0), (False, 1.0, 1 / 1.2), (True, 0.0, 1.0)]
)
def test_the_sheet_stretches_by_the_given_amount(held: bool, poisson: float, across: float) -> None:
    options = StretchingOptions(stretch=0.2, poisson=poisson, held=held)
    sheet = deforming_scene("stretching", options).sheets[0]
    rest, pulled = sheet.shape(0.0), sheet.shape(2.0)
    along = np.diff(pulled[:, :, 0], axis=1) / np.diff(rest[:, :, 0], axis=1)
    assert along.max() == pytest.approx(1.2, abs=1e-3)
    assert along.mean() == pytest.approx(1.0 if held else 1.2, abs=1e-3)
    wide = np.diff(pulled[:, :, 1], axis=0) / np.diff(rest[:, :, 1], axis=0)
    np.testing.assert_allclose(wide, across, rtol=1e-9)


def strain(scene: DeformingScene, times_s: list[float], cells: int) -> np.ndarray:
    """(T,) rms change of the lengths of lines of so many cells of the first sheet."""
    shapes = np.array([scene.sheets[0].shape(time) for time in [0.0, *times_s]])
    steps = (np.diff(shapes[:, :, ::cells], axis=2), np.diff(shapes[:, ::cells], axis=1))
    lengths = [np.linalg.norm(each, axis=3).reshape(len(shapes), -1) for each in steps]
    ratios = np.concatenate(lengths, axis=1)
    return np.sqrt(np.mean((ratios[1:] / ratios[0] - 1.0) ** 2, axis=1))


def test_the_paper_is_near_its_points_and_keeps_its_lengths() -> None:
    scene = deforming_scene("kinect-paper", PaperOptions(), TRACKS)
    surface = scene.sheets[0].shape(2.0 * KEY_EVERY_S).reshape(-1, 3)
    k = 1.4
    u = np.arcsin(surface[:, 0] * k) / k
    np.testing.assert_allclose(surface[:, 2], 0.55 + (1.0 - np.cos(k * u)) / k, atol=1e-3)
    assert strain(scene, [0.1, 0.3, 0.5, 0.9], 3).max() < 2e-3
    np.testing.assert_allclose(points_at(TRACKS, KEY_EVERY_S), TRACKS[1], atol=1e-12)
    np.testing.assert_allclose(points_at(TRACKS, 99.0), TRACKS[-1], atol=1e-12)
    nodes, places = np.random.default_rng(0).random((2, 30, 2))
    np.testing.assert_allclose(plate_weights(nodes, places) @ nodes, places, atol=1e-9)


@pytest.mark.skipif(not REAL_TRACKS.is_file(), reason="shared/data is not here")
def test_the_real_paper_is_hardly_strained() -> None:
    with np.load(REAL_TRACKS) as content:
        tracks = content["P_gt_mm"].astype(np.float64) * 1e-3
    scene = deforming_scene("kinect-paper", PaperOptions(), tracks)
    measured = [8 * k / 30.0 for k in range(1, len(tracks), 3)]
    assert strain(scene, measured, 3).max() < 4e-3


def contents(folder: Path) -> dict[str, bytes]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_a_folder_is_the_same_in_every_rendering(tmp_path: Path) -> None:
    source = "built-in:sliding?frames=22&width=64&tool=1&light=0.3&gloss=1&drop=3"
    first = builtin_folder(source, cache=tmp_path)
    assert contents(builtin_folder(source, cache=tmp_path / "again")) == contents(first)
    times = [float(line.split()[0]) for line in (first / "rgb.txt").read_text().splitlines()[1:]]
    np.testing.assert_allclose(np.array(times) * 30.0, [*range(20), 23, 24], atol=1e-6)
    with np.load(first / builtin_deforming.SURFACES_NAME) as surfaces:
        assert surfaces["names"].tolist() == ["front", "rear", "tool"]
        assert surfaces["vertices_0"].shape == (22, 81, 51, 3)


def test_options_show_in_the_image() -> None:
    frames = {}
    given: list[dict[str, Any]] = [{}, {"tool": True}, {"gloss": 1.0}, {"light": 0.4}]
    for option in given:
        options = DEFORMING["sliding"].options(**option)
        scene = deforming_scene("sliding", options)
        textures = [paint_sheet(scene, i) for i in range(len(scene.sheets))]
        frames[next(iter(option), "")] = SheetRenderer(scene, textures, CAMERA).frame(18, 0.6)
    plain = frames[""].image.astype(int)
    covered = frames["tool"].depth_m < frames[""].depth_m - 0.05
    assert 0.01 < covered.mean() < 0.2
    spots = frames["gloss"].image == 255
    assert 1e-4 < spots.mean() < 0.05
    assert (frames["gloss"].image >= plain).all()
    assert np.abs(frames["light"].image - plain).mean() > 5.0
    np.testing.assert_array_equal(frames["light"].depth_m, frames[""].depth_m)
    assert frame_numbers(45, 0) == list(range(45))


def test_what_is_a_deforming_source() -> None:
    assert is_deforming("built-in:breathing?amplitude=0.01")
    assert not is_deforming("built-in:room")
    assert not is_deforming("breathing")


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("built-in:kinect-paper", "add ?tracks=PATH"),
        ("built-in:kinect-paper?tracks=/no/such.npz", "/no/such.npz: no such file"),
        ("built-in:kinect-paper?tracks={tmp}/text", "holds no array P_gt_mm"),
        ("built-in:kinect-paper?tracks={tmp}/flat.npz", "should be (frames, points, 3)"),
        ("built-in:kinect-paper?tracks={tmp}/behind.npz", "not in front of the camera"),
        ("built-in:sliding?amplitude=0.1", "unknown option 'amplitude'; valid options: frames"),
        ("built-in:breathing?amplitude=2", "amplitude=2"),
        ("built-in:breathing?frames=121", "has only 120 frames"),
    ],
)
def test_wrong_sources_get_one_clear_line(source: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "text").write_text("no numbers")
    np.savez(tmp_path / "flat.npz", P_gt_mm=np.zeros((3, 4)))
    np.savez(tmp_path / "behind.npz", P_gt_mm=np.zeros((3, 4, 3)))
    with pytest.raises(DatasetError) as caught:
        builtin_folder(source.format(tmp=tmp_path), cache=tmp_path / "cache")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_camera_is_on_its_way_when_the_first_shutter_opens() -> None:
    scene = deforming_scene("breathing", DEFORMING["breathing"].options())
    opens, middle, closes = (scene.path.T_world_camera(t)[:3, 3] for t in (-0.005, 0.0, 0.005))
    assert np.linalg.norm(closes - opens) > 1e-4
    np.testing.assert_allclose(0.5 * (opens + closes), middle, atol=1e-5)


def test_a_longer_film_continues() -> None:
    options = DEFORMING["breathing"].options(seconds=10.0)
    scene = deforming_scene("breathing", options)
    assert scene.frames == 300
    late = [scene.path.T_world_camera(t)[:3, 3] for t in (8.0, 9.0)]
    assert np.linalg.norm(late[1] - late[0]) > 0.005
