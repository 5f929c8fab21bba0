"""``pliant run --profile deformable`` with real processes, and what follows from its recording."""

import json
from pathlib import Path

import numpy as np
import pytest
from running import assert_one_line, pliant

pytestmark = pytest.mark.system

FRAMES = 4
TINY = f"built-in:tiny?frames={FRAMES}"
FEW = ("--set", "surfels.max_surfels=60", "--set", "bus.checkpoint_frames=1")


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("surfels") / "tiny"
    done = pliant("run", TINY, "--profile", "deformable", "--output", folder, *FEW)
    assert done.returncode == 0, done.stderr
    assert f"{FRAMES} frames" in done.stdout
    return folder


def test_a_run_leaves_everything_a_user_opens(result: Path) -> None:
    report = json.loads((result / "report.json").read_text())
    assert report["complete"]
    assert report["frames"] == report["frames_with_pose"] == FRAMES
    assert report["births"] == 60
    assert len(report["alive_per_frame"]) == FRAMES
    assert report["alive_per_frame"][0] == 60
    assert len(np.loadtxt(result / "trajectory.txt")) == FRAMES
    with np.load(result / "surfels.npz") as surfels:
        counts = surfels["counts"]
        assert counts.sum() == len(surfels["ids"]) == len(surfels["positions"])
        alive = np.split(surfels["state"] == 0, np.cumsum(counts)[:-1])
        assert [int(a.sum()) for a in alive] == report["alive_per_frame"]
        assert surfels["T_world_camera"].shape == (FRAMES, 4, 4)


def test_a_replay_and_a_run_on_the_recording_give_the_same(result: Path, tmp_path: Path) -> None:
    again = pliant(
        "replay", result, "--services", "surfels", "--check", "--output", tmp_path / "replay"
    )
    assert again.returncode == 0, again.stdout + again.stderr
    assert "the same bytes as recorded: surfels/state" in again.stdout
    once_more = pliant(
        "run", result, "--profile", "deformable", "--output", tmp_path / "run",
        "--on-crash", "restart", *FEW,
    )  # fmt: skip
    assert once_more.returncode == 0, once_more.stderr
    expected = (result / "surfels.npz").read_bytes()
    for folder in ("replay", "run"):
        assert (tmp_path / folder / "surfels.npz").read_bytes() == expected, folder


def test_wrong_use_is_one_line(tmp_path: Path) -> None:
    done = pliant("run", TINY, "--camera", "static", "--output", tmp_path / "x")
    assert done.returncode == 2
    assert "--profile deformable" in done.stderr
    images = tmp_path / "images"
    images.mkdir()
    (images / "0.pgm").write_bytes(b"P5 64 48 255 " + bytes(64 * 48))
    done = pliant("run", images, "--fov", "60", "--profile", "deformable")
    assert_one_line(done, "brings no depth along")
