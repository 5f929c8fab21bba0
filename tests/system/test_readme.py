"""What the README tells a newcomer to type works, in a clean folder, and so does the notebook."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import pytest
from running import AS_FROM_A_SHELL, TIMEOUT_S, pliant

from pliant.datasets.builtin import builtin_folder

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
OUTPUTS = (ROOT / "docs" / "outputs.md").read_text(encoding="utf-8")
FRAMES_A_SECOND = 20.0


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def commands() -> list[str]:
    """Each ``pliant`` command of the README, without its comment."""
    lines = [line for block in blocks("sh") for line in block.splitlines()]
    return [line.split("#")[0].strip() for line in lines if line.startswith("pliant ")]


@pytest.fixture(scope="module")
def sequence() -> Path:
    """Half the width and the frames of built-in:tiny, whose run is that of the notebook."""
    return builtin_folder("built-in:tiny?width=160&frames=24")


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


@pytest.fixture(scope="module")
def after_all_commands(clean_folder: Path) -> Path:
    """The folder after every command of the README, in order."""
    for command in commands():
        if "camera:" in command:  # there may be none, or one that films for ever
            continue
        done = pliant(*shlex.split(command)[1:], cwd=clean_folder)
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        # The README shows several ways to run one video; somebody who tries all adds --force.
        shutil.rmtree(clean_folder / "results" / "video.mp4", ignore_errors=True)
    return clean_folder


def test_every_command_of_the_readme_works_in_a_clean_folder(after_all_commands: Path) -> None:
    assert {"run", "eval", "export"} <= {command.split()[1] for command in commands()}
    left = {path.name for path in after_all_commands.iterdir()}
    assert left == {"path", "calib.yaml", "video.mp4", "results"}


def test_a_run_leaves_the_files_of_the_table(after_all_commands: Path) -> None:
    (table,) = re.findall(r"^\| file \|.*?\n\n", OUTPUTS, re.MULTILINE | re.DOTALL)
    first = [line.split("|")[1] for line in table.strip().splitlines()[2:]]
    promised = {name for cell in first for name in re.findall(r"`([^`]+)`", cell)}
    left = {path.name for path in (after_all_commands / "results" / "sequence").iterdir()}
    assert promised == left - {"overlay.webm", "eval.json", ".lock"}


@pytest.mark.skipif(os.path.exists("/dev/video0"), reason="there is a camera, which never ends")
def test_a_camera_that_is_not_there_is_one_line(clean_folder: Path) -> None:
    (command,) = [command for command in commands() if "camera:" in command]
    done = pliant(*shlex.split(command)[1:], cwd=clean_folder)
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert "camera" in line


def test_the_python_example_maps_a_video(
    clean_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (example,) = blocks("python")
    monkeypatch.chdir(clean_folder)
    names: dict[str, Any] = {}
    exec(compile(example, "README.md", "exec"), names)
    assert len(names["result"].trajectory) > 20
    assert len(names["result"].mesh.triangles) > 1000


def test_the_notebook_runs(tmp_path: Path) -> None:
    """Its cells one after the other, as a notebook has them, in a process of their own."""
    cells = json.loads((ROOT / "docs" / "example.ipynb").read_text(encoding="utf-8"))["cells"]
    assert not any(cell.get("outputs") for cell in cells)
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    script = tmp_path / "cells.py"
    script.write_text("\n".join(code))
    done = subprocess.run(
        [*AS_FROM_A_SHELL, sys.executable, script],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert "40 poses" in done.stdout
    assert "good because" in done.stdout
