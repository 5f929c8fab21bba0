"""What the README tells a newcomer to type works, in a clean folder."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

from pliant.datasets.builtin import builtin_folder

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
TIMEOUT_S = 300
FRAMES_A_SECOND = 20.0


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def commands() -> list[str]:
    """Each ``pliant`` command of the README, without its comment."""
    lines = [line for block in blocks("sh") for line in block.splitlines()]
    return [line.split("#")[0].strip() for line in lines if line.startswith("pliant ")]


@pytest.fixture(scope="module")
def sequence() -> Path:
    return builtin_folder("built-in:tiny")


@pytest.fixture(scope="module")
def clean_folder(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's folder, with everything that the README takes for granted under its name."""
    folder = tmp_path_factory.mktemp("readme")
    shutil.copytree(sequence, folder / "path" / "to" / "sequence")
    shutil.copy(sequence / "calib.yaml", folder)
    images = [cv2.imread(str(p)) for p in sorted((sequence / "images").iterdir())]
    height, width = images[0].shape[:2]
    codec = cv2.VideoWriter.fourcc(*"mp4v")
    video = cv2.VideoWriter(str(folder / "video.mp4"), codec, FRAMES_A_SECOND, (width, height))
    for image in images:
        video.write(image)
    video.release()
    return folder


def pliant(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "pliant_services.cli", *shlex.split(command)[1:]],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        cwd=folder,
    )


@pytest.fixture(scope="module")
def after_all_commands(clean_folder: Path) -> Path:
    """The folder after every command of the README, in order."""
    for command in commands():
        if "camera:" in command:  # there may be none, or one that films for ever
            continue
        done = pliant(command, clean_folder)
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        # The README shows several ways to run one video; somebody who tries all adds --force.
        shutil.rmtree(clean_folder / "results" / "video.mp4", ignore_errors=True)
    return clean_folder


def test_every_command_of_the_readme_works_in_a_clean_folder(after_all_commands: Path) -> None:
    assert {"run", "eval", "export"} <= {command.split()[1] for command in commands()}
    left = {path.name for path in after_all_commands.iterdir()}
    assert left == {"path", "calib.yaml", "video.mp4", "results"}


def test_a_run_leaves_the_files_of_the_table(after_all_commands: Path) -> None:
    rows = [line for line in README.splitlines() if line.startswith("| `")]
    promised = {name for row in rows for name in re.findall(r"`([^`]+)`", row.split("|")[1])}
    assert "trajectory.txt" in promised
    for name in promised:
        assert (after_all_commands / "results" / "sequence" / name).stat().st_size > 0, name


@pytest.mark.skipif(os.path.exists("/dev/video0"), reason="there is a camera, which never ends")
def test_a_camera_that_is_not_there_is_one_line(clean_folder: Path) -> None:
    (command,) = [command for command in commands() if "camera:" in command]
    done = pliant(command, clean_folder)
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert "camera" in line


def test_the_python_example_maps_a_video(
    sequence: Path,
    clean_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (example,) = blocks("python")
    monkeypatch.chdir(clean_folder)
    images = [str(path) for path in sorted((sequence / "images").iterdir())]
    exec(compile(example, "README.md", "exec"), {"image_paths": images})
    said = capsys.readouterr().out
    rows = re.findall(r"^(\d+) (\d+) (?:None|\[\[)", said, re.MULTILINE)
    assert [int(frame) for frame, _ in rows] == list(range(len(images)))
    (poses,) = re.findall(r"^(\d+) poses$", said, re.MULTILINE)
    assert int(poses) > len(images) // 2


def test_the_files_that_the_readme_points_to_are_there() -> None:
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", README):
        assert (ROOT / target).exists(), target
