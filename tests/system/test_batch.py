"""``pliant batch`` as a shell uses it: interrupted, gone on with, with a clip that is none."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Generator
from pathlib import Path

import pytest
from running import (
    AS_FROM_A_SHELL,
    NO_MESH,
    TIMEOUT_S,
    TINY,
    UP,
    assert_one_line,
    command,
    digests,
    in_this_process,
    pliant,
)

from pliant.datasets.builtin import builtin_folder
from pliant.results.folder import has_frames
from pliant_services.batch import on_cluster

pytestmark = [pytest.mark.slow, pytest.mark.system]
OPTIONS = NO_MESH

CLUSTER = """
import sys
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Generator[str]:
    """The address of a cluster whose workers are processes in a folder of their own."""
    pytest.importorskip("distributed")
    folder = tmp_path_factory.mktemp("cluster")
    (folder / "cluster.py").write_text(CLUSTER)
    with (
        (folder / "log").open("w") as log,
        subprocess.Popen(
            [*AS_FROM_A_SHELL, sys.executable, "cluster.py"], cwd=folder, text=True, stderr=log,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        ) as process,
    ):  # fmt: skip
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        assert address, (folder / "log").read_text()
        yield address
        process.communicate(timeout=TIMEOUT_S)


@pytest.fixture(params=["--jobs", "--dask"])
def engine(request: pytest.FixtureRequest) -> tuple[str, str]:
    if request.param == "--jobs":
        return "--jobs", "2"
    return "--dask", request.getfixturevalue("scheduler")


def disturbed(
    arguments: list[str], log: Path, disturb: Callable[[subprocess.Popen[str]], None]
) -> tuple[int, str, str]:
    """Do something to a batch once the services of a clip are up, as its log says."""
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
        disturb(batch)
        output, errors = batch.communicate(timeout=TIMEOUT_S)
    assert seen, errors
    return batch.returncode, output, errors


def test_an_interrupted_batch_resumes_and_a_broken_clip_stops_no_other(
    tmp_path: Path, tiny_run: Path, engine: tuple[str, str]
) -> None:
    clips, output = tmp_path / "clips", tmp_path / "results"
    shutil.copytree(builtin_folder(TINY), clips / "tiny scene")
    (clips / "broken.mp4").write_text("no video")
    (clips / "notes.txt").write_text("of the day")
    again = ("batch", clips, "--output", output, *engine, *OPTIONS)

    def interrupt(batch: subprocess.Popen[str]) -> None:
        while not has_frames(output / "tiny_scene"):
            assert batch.poll() is None
        batch.send_signal(signal.SIGINT)

    code, table, errors = disturbed(command(*again), output / "logs" / "tiny_scene.log", interrupt)
    assert code == 130, errors
    assert "Traceback" not in errors
    assert "tiny_scene  begun" in table
    first = json.loads((output / "batch.json").read_text())["clips"]
    assert [clip["state"] for clip in first] == ["failed", "begun"]

    done = pliant(*again)
    assert done.returncode == 1, done.stderr  # of the broken one
    assert "tiny_scene: started again" in done.stderr
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
    assert_one_line(
        in_this_process("batch", clips, "--output", output), "started with other options of run"
    )


def test_the_clip_of_a_worker_that_is_killed_goes_to_another_one(
    tmp_path: Path, tiny_run: Path, scheduler: str
) -> None:
    """Whose run lives on: the other one waits for it, and takes what it has left."""
    clips, output = tmp_path / "clips", tmp_path / "results"
    shutil.copytree(builtin_folder(TINY), clips / "tiny scene")

    def kill_worker(_: subprocess.Popen[str]) -> None:
        run = (output / "tiny_scene" / ".lock").read_text().strip()
        told = subprocess.run(["ps", "-o", "ppid=", "-p", run], capture_output=True, text=True)
        os.kill(int(told.stdout), signal.SIGKILL)

    arguments = command("batch", clips, "--output", output, "--dask", scheduler, *OPTIONS)
    code, table, errors = disturbed(arguments, output / "logs" / "tiny_scene.log", kill_worker)
    assert code == 0, errors
    assert "Traceback" not in errors
    assert "tiny_scene: started again on" in errors
    assert "1 of 1 done" in table
    assert digests(output / "tiny_scene") == digests(tiny_run)


def test_no_scheduler_no_dask_and_workers_without_the_clips_are_one_line(
    tmp_path: Path, scheduler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(on_cluster, "_ANSWERS_S", 1.0)  # nobody listens: longer says no more
    (tmp_path / "clips").mkdir()
    (tmp_path / "clips" / "a.mp4").touch()
    (tmp_path / "none" / "distributed").mkdir(parents=True)
    (tmp_path / "none" / "distributed" / "__init__.py").write_text("raise ImportError('none')")
    batch = ("batch", "clips", "--dask")
    done = in_this_process(*batch, "tcp://127.0.0.1:1", cwd=tmp_path)
    assert_one_line(done, "--dask tcp://127.0.0.1:1: no answer from a scheduler")
    for address in ("nonsense://rack:8786", "tcp://", "rack", ""):
        done = in_this_process(*batch, address, cwd=tmp_path)
        assert_one_line(done, "no answer from a scheduler")
    without = {"PYTHONPATH": str(tmp_path / "none")}
    done = pliant(*batch, "tcp://127.0.0.1:1", cwd=tmp_path, env=without)
    assert_one_line(done, "needs Dask: pip install 'pliant[dask]'")
    done = in_this_process(*batch, scheduler, "--jobs", "2", cwd=tmp_path)
    assert_one_line(done, "--jobs is for one machine", 2)
    assert [path.name for path in tmp_path.iterdir()] == ["clips", "none"]


def test_what_run_would_not_take_is_refused_before_anything_is_begun(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").touch()
    for options, says, code in (
        (["--nonsense"], "No such option: --nonsense", 2),
        (["--force"], "--force applies to a single run", 1),
        (["--profile", "elastic"], "elastic", 2),
        (["elsewhere"], "unexpected extra argument", 2),
    ):
        done = in_this_process("batch", tmp_path, *options, cwd=tmp_path)
        assert_one_line(done, says, code)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
