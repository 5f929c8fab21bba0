"""The surface of report.html that moves: its key frames, its size, and what a browser shows."""

import base64
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import in_browser
from surfel_sheet import surfels_in

from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.results.page.moved_surface import Surface, moving_mesh
from pliant.results.page.page import canvas


def surface_of_frames(count: int, side: int = 11) -> Surface:
    surface = Surface()
    for k in range(count):
        surface.take(surfels_in(k, 0.2 * k / max(count - 1, 1), side))
    return surface


def layer_of(surface: Surface) -> tuple[dict[str, object], int]:
    scene, full = surface.scene()
    assert full == pytest.approx(0.2, abs=0.03)
    (mesh,) = (each for each in json.loads(scene.header)["layers"] if each["name"] == "mesh")
    return mesh, len(base64.b64decode(scene.bytes))


def test_each_key_frame_is_a_mesh_of_its_own() -> None:
    frames = [surfels_in(k, 0.1 * k) for k in range(3)]
    frames[1] = replace(frames[1], state=np.where(frames[1].ids == 60, 1, 0).astype(np.uint8))
    mesh, _ = moving_mesh(frames)
    assert mesh.first_vertices.tolist() == [0, 121, 241]
    assert mesh.names == ["frame 0", "frame 1", "frame 2"]
    assert mesh.times_s == pytest.approx([0.0, 0.1, 0.2])
    ends = [*mesh.first_triangles[1:], len(mesh.triangles)]
    borders = [*mesh.first_vertices, len(mesh.positions)]
    for k, (first, end) in enumerate(zip(mesh.first_triangles, ends, strict=True)):
        mine = mesh.triangles[first:end]
        assert (mine.min(), mine.max()) == (borders[k], borders[k + 1] - 1)
        tracked = frames[k].positions[frames[k].state == SurfelState.TRACKED]
        np.testing.assert_array_equal(mesh.positions[borders[k] : borders[k + 1]], tracked)
    grey, red = mesh.colours[:121].astype(int), mesh.colours[241:].astype(int)
    assert (np.ptp(grey, axis=1) < 10).all()
    assert (red[:, 0] - red[:, 2] > 100).all()


def test_a_long_run_has_few_key_frames_and_its_last_frame() -> None:
    mesh, size = layer_of(surface_of_frames(450))
    keys = mesh["keys"]
    assert isinstance(keys, list)
    assert 50 <= len(keys) <= 101
    assert (keys[0]["name"], keys[-1]["name"]) == ("frame 0", "frame 449")
    assert size < 1_600_000


def test_many_surfels_are_thinned_out() -> None:
    mesh, size = layer_of(surface_of_frames(30, side=60))
    keys = mesh["keys"]
    assert isinstance(keys, list)
    assert len(keys) == 30
    assert 400 < keys[-1]["vertices"][1] - keys[-1]["vertices"][0] < 3600
    assert size < 1_700_000


@pytest.mark.parametrize(("key", "red"), [(0, False), (4, True)])
def test_a_browser_draws_the_chosen_key_frame(key: int, red: bool, tmp_path: Path) -> None:
    scene, _ = surface_of_frames(5).scene()
    style = "canvas { width: 600px; height: 400px; display: block }"
    chosen = f'const at = document.querySelector("#time input"); at.value = {key}; at.oninput();'
    body = f"<style>{style}</style>{canvas(scene)}<script>{chosen}</script>"
    page, picture = tmp_path / "page.html", tmp_path / "page.png"
    page.write_text(f'<!doctype html><meta charset="utf-8">{body}', encoding="utf-8")
    assert f"frame {key}, 0.{key}0 s" in in_browser(page, tmp_path, "--dump-dom").stdout
    done = in_browser(page, tmp_path, f"--screenshot={picture}")
    assert picture.exists(), done.stderr
    view = cv2.imread(str(picture))[10:400, 10:600].astype(int)
    drawn = view.max(axis=2) > 60
    assert drawn.mean() > 0.1
    is_red = view[..., 2] - view[..., 0] > 60
    assert (is_red[drawn].mean() > 0.9) if red else (is_red[drawn].mean() < 0.05)
