"""``pliant view --open3d``: a result in a window, on a display that nobody sees."""

import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from running import assert_one_line, in_this_process

from pliant.open3d_library import Open3dError, load_open3d
from pliant.pictures.map import BACKGROUND, PATH_COLOUR

pytestmark = pytest.mark.system

SCREENSHOT = """
import sys, pliant
from pliant_services.view.open3d_window import opened
window = opened(pliant.open(sys.argv[1]))
for _ in range(3):
    window.poll_events()
    window.update_renderer()
window.capture_screen_image(sys.argv[2], True)
window.destroy_window()
"""


@pytest.fixture
def has_open3d() -> None:
    try:
        load_open3d()
    except Open3dError as error:
        pytest.skip(f"open3d is installed but cannot be loaded ({error})")


@pytest.mark.usefixtures("has_open3d")
def test_points_mesh_and_path_are_drawn(tiny_run: Path, tmp_path: Path) -> None:
    if shutil.which("xvfb-run") is None:
        pytest.skip("xvfb is not installed")
    picture = tmp_path / "window.png"
    display = ("xvfb-run", "--auto-servernum", "--server-args", "-screen 0 1400x1000x24")
    command = [*display, sys.executable, "-c", SCREENSHOT, str(tiny_run), str(picture)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    data = cv2.imread(str(picture), cv2.IMREAD_COLOR_RGB)
    assert data is not None
    seen = data.astype(int)
    drawn = np.abs(seen - BACKGROUND).max(axis=2) > 8
    assert 0.1 < drawn.mean() < 0.95
    assert (np.abs(seen - PATH_COLOUR).max(axis=2) < 8).sum() > 50
    assert len(np.unique(seen[drawn] // 16, axis=0)) > 10  # textured, not of one shade


def test_what_cannot_be_shown_is_one_line(
    tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert_one_line(in_this_process("view", tiny_run, "--open3d"), "there is no display here")
    assert_one_line(in_this_process("view", tiny_run, "--open3d", "--web"), "leave out --web")
    save = ("--save", tmp_path / "x.rrd")
    assert_one_line(in_this_process("view", tiny_run, "--open3d", *save), "leave out --web, --save")
    assert_one_line(in_this_process("view", "--open3d"), "nothing to view")


@pytest.mark.usefixtures("has_open3d")
def test_a_display_that_does_not_answer_is_one_line(
    tiny_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DISPLAY", ":98765")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert_one_line(in_this_process("view", tiny_run, "--open3d"), "cannot open a window")
