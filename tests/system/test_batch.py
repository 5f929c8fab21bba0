"""``pliant batch`` as a shell uses it: interrupted, gone on with, with a clip that is none."""

import json
import shutil
import signal
import subprocess
from pathlib import Path

import pytest
from running import TIMEOUT_S, TINY, UP, assert_one_line, command, digests, pliant

from pliant.datasets.builtin import builtin_folder

pytestmark = [pytest.mark.slow, pytest.mark.system]
OPTIONS = ("--set", "meshing.enabled=false")


def interrupted(arguments: list[str], log: Path) -> tuple[int, str, str]:
    """Ctrl-C once the services of a clip are up, as its log says."""
    log.parent.mkdir(parents=True)
    log.touch()
    (log.parent.parent / "batch.json").write_text(json.dumps({"options": OPTIONS, "clips": []}))
    with subprocess.Popen(
        arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as batch:
        follow = ["tail", f"--pid={batch.pid}", "-n", "+1", "-F", log]  # to the batch's own end
        with subprocess.Popen(
            follow, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        ) as tail:
            assert tail.stdout is not None
            seen = any(UP in line for line in tail.stdout)
            tail.kill()
        batch.send_signal(signal.SIGINT)
        output, errors = batch.communicate(timeout=TIMEOUT_S)
    assert seen, errors
    return batch.returncode, output, errors


def test_an_interrupted_batch_goes_on_and_a_broken_clip_stops_nobody(
    tmp_path: Path, tiny_run: Path
) -> None:
    clips, output = tmp_path / "clips", tmp_path / "results"
    shutil.copytree(builtin_folder(TINY), clips / "tiny scene")
    (clips / "broken.mp4").write_text("no video")
    (clips / "notes.txt").write_text("of the day")
    again = ("batch", clips, "--output", output, "--jobs", "2", *OPTIONS)

    code, table, errors = interrupted(command(*again), output / "logs" / "tiny_scene.log")
    assert code == 130, errors
    assert "Traceback" not in errors
    assert "tiny_scene  begun" in table
    first = json.loads((output / "batch.json").read_text())["clips"]
    assert [clip["state"] for clip in first] == ["failed", "begun"]

    done = pliant(*again)
    assert done.returncode == 1, done.stderr  # of the broken one
    assert "tiny_scene: begun again" in done.stderr
    assert "1 of 2 done" in done.stdout
    assert digests(output / "tiny_scene") == digests(tiny_run)
    broken, tiny = json.loads((output / "batch.json").read_text())["clips"]
    assert "not a video that OpenCV can read" in broken["reason"]
    assert (tiny["verdict"], tiny["frames"], tiny["longest_share"]) == ("good", 40, 1.0)
    assert tiny["seconds"] > first[1]["seconds"] > 0.0

    (clips / "broken.mp4").unlink()
    at_last = pliant(*again)
    assert at_last.returncode == 0, at_last.stderr
    assert at_last.stderr == ""  # nothing was left to do
    assert "1 of 1 done" in at_last.stdout
    assert_one_line(pliant("batch", clips, "--output", output), "begun with other options of run")


def test_what_run_would_not_take_is_refused_before_anything_is_begun(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").touch()
    for options, says, code in (
        (["--nonsense"], "No such option: --nonsense", 2),
        (["--force"], "--force is for one run", 1),
        (["--profile", "elastic"], "elastic", 2),
        (["elsewhere"], "unexpected extra argument", 2),
    ):
        done = pliant("batch", tmp_path, *options, cwd=tmp_path)
        assert_one_line(done, says, code)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
