"""The user who does everything wrong: one clear line, the right exit code, and nothing lost."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Generator, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from running import (
    NO_MESH,
    TIMEOUT_S,
    TINY,
    UP,
    assert_one_line,
    command,
    has_ended,
    in_this_process,
    pliant,
    running,
    write_sequence,
)

from pliant.bus.session import free_endpoint, open_router
from pliant.datasets.builtin import builtin_folder
from pliant.messages import topics
from pliant.recording.reader import Recording
from pliant_services.profiles import PROFILES
from pliant_services.runtime.launcher import Fleet, ServiceDiedError

pytestmark = pytest.mark.system

IMAGE = np.random.default_rng(0).integers(0, 256, (48, 64), np.uint8)
IMAGES = [IMAGE] * 3


# -- mistakes that are found before anything starts -----------------------------------------------


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with some bad input, as the working folder."""
    builtin_folder(TINY)  # on a new machine it would be rendered, and say so
    (tmp_path / "file").write_text("hello\n")
    (tmp_path / "empty").mkdir()
    (tmp_path / "others").mkdir()
    (tmp_path / "others" / "notes.txt").write_text("hello\n")
    (tmp_path / "misspelt.yaml").write_text("tracking:\n  min_curvatur: 8\n")
    (tmp_path / "binary.yaml").write_bytes(b"\0\xff\xfe")
    (tmp_path / "broken.yaml").write_text("bus: [1\n")
    for name, since in (("poses.txt", 0), ("later.txt", 100)):
        (tmp_path / name).write_text("".join(f"{since + i} {i} 0 0 0 0 0 1\n" for i in range(3)))
    write_sequence(tmp_path / "result", IMAGES)
    write_sequence(tmp_path / "nan", IMAGES, fx=float("nan"))
    write_sequence(tmp_path / "negative", IMAGES, fy=-50.0)
    write_sequence(tmp_path / "wrong_size", IMAGES, width=640, height=480, fx=500.0, fy=500.0)
    write_sequence(tmp_path / "no_focal", IMAGES, fx=None)
    write_sequence(tmp_path / "repeats", IMAGES, stamps=[0.0, 0.1, 0.1])
    write_sequence(tmp_path / "backwards", IMAGES, stamps=[0.0, 0.2, 0.1])
    write_sequence(tmp_path / "not_images", [b"no", IMAGE])
    (tmp_path / "not_images" / "images" / "0001.png").write_bytes(b"no")
    monkeypatch.chdir(tmp_path)
    return tmp_path


LONG = "x" * 300
MISTAKES: list[tuple[Sequence[str], int, Sequence[str]]] = [
    (["run", "nan"], 1, ["nan/calib.yaml", "fx", "finite"]),
    (["run", "negative"], 1, ["negative/calib.yaml", "fy is -50", "positive"]),
    (["run", "wrong_size"], 1, ["wrong_size/calib.yaml", "640x480", "64x48"]),
    (["run", "no_focal"], 1, ["no_focal/calib.yaml", "fx", "add"]),
    (["run", "repeats"], 1, ["repeats/rgb.txt", "line 3", "repeats that of line 2"]),
    (["run", "backwards"], 1, ["backwards/rgb.txt", "line 3", "runs backwards"]),
    (["run", "not_images"], 1, ["not_images/images/0000.png", "decode"]),
    (["run", "empty"], 1, ["empty: is an empty folder", "docs/sources.md"]),
    (["run", "."], 1, [".: is not a source, but contains several", "pliant batch ."]),
    (["run", "others"], 1, ["others: contains no source", "docs/sources.md"]),
    (["run", "nowhere"], 1, ["nowhere: no such file or folder"]),
    (["run", LONG], 1, ["too long"]),
    (["run", "/dev/null"], 1, ["neither a file nor a folder"]),
    (["run", ""], 1, ["is empty; see `pliant run --help`"]),
    (["run", "file"], 1, ["file: not a video"]),
    (["run", "camera:77"], 1, ["no such camera"]),
    (["run", "built-in:nowhere"], 1, ["built-in:room"]),
    (["run", "built-in:kinect-paper", "--profile", "deformable"], 1, ["?tracks=PATH"]),
    (["render", "built-in:kinect-paper?tracks=no.npz"], 1, ["no.npz: no such file"]),
    (["run", TINY + "?frames=many"], 1, ["frames=many"]),
    (["run", TINY, "--fov", "nan"], 1, ["1 to 170 degrees"]),
    (["run", TINY, "--fov", "60", "--calibration", "file"], 1, ["exclude each other"]),
    (["run", TINY, "--calibration", "nowhere.yaml"], 1, ["nowhere.yaml", "no such"]),
    (["run", TINY, "--output", "result"], 1, ["result exists", "--force"]),
    (["run", TINY, "--output", "file", "--force"], 1, ["file is a file", "--output"]),
    (["run", TINY, "--output", "file/deep"], 1, ["file is a file", "--output"]),
    (["run", TINY, "--output", LONG], 1, ["too long", "--output"]),
    (["run", TINY, "--set", "tracking.min_curvatur=8"], 1, ["did you mean", "min_curvature"]),
    (["run", TINY, "--set", "tracking"], 1, ["expected KEY=VALUE"]),
    (["run", TINY, "--set", "bus.window=0"], 1, ["bus.window", "greater"]),
    (["run", TINY, "--seed", "-1"], 1, ["seed", "greater"]),
    (["run", TINY, "--config", "misspelt.yaml"], 1, ["misspelt.yaml", "did you mean"]),
    (["run", TINY, "--config", "binary.yaml"], 1, ["binary.yaml: not YAML"]),
    (["run", TINY, "--config", "broken.yaml"], 1, ["broken.yaml: not YAML", "line 1"]),
    (["run", TINY, "--config", "nowhere.yaml"], 1, ["nowhere.yaml", "No such file"]),
    (["run", TINY, "--config", "empty"], 1, ["empty", "directory"]),
    (["run", TINY, "--start", "99"], 1, ["built-in:tiny: is 1.30 s long", "--start 99 s"]),
    (["run", TINY, "--resume", "--poses"], 2, ["--poses needs a run from its start"]),
    (["run", TINY, "--mode", "nonsense"], 2, ["--mode", "lossless", "live", "--help"]),
    (["run", TINY, "--port", "99999"], 2, ["--port", "65535"]),
    (["run", TINY, "--no-such-option"], 2, ["--no-such-option", "run --help"]),
    (["eval", "poses.txt", "-g", "later.txt"], 1, ["poses.txt: no accuracy", "in later.txt: "]),
    (["run"], 2, ["source", "run --help"]),
    (["juggle"], 2, ["juggle", "--help"]),
    (["service", "tracking", "--connect", "nonsense"], 1, ["nonsense", "tcp/127.0.0.1:7447"]),
    (["service", "juggling", "--connect", "tcp/127.0.0.1:1"], 1, ["tracking"]),
]


@pytest.mark.parametrize(("arguments", "code", "texts"), MISTAKES, ids=lambda x: str(x)[:60])
def test_a_mistake_is_one_line(
    here: Path, arguments: Sequence[str], code: int, texts: Sequence[str]
) -> None:
    before = sorted(here.rglob("*"))
    done = in_this_process(*arguments)
    assert_one_line(done, "pliant: ", code)
    assert done.stderr.startswith("pliant: ")
    assert all(text in done.stderr for text in texts), done.stderr
    assert done.stdout == ""
    assert sorted(here.rglob("*")) == before, "a mistake leaves nothing behind"


def test_a_source_that_fails_before_its_first_frame_leaves_no_result(here: Path) -> None:
    part = ("--start", "1.01", "--end", "1.02")
    done = in_this_process("run", TINY, *part, *NO_MESH, "--output", "part", cwd=here)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("pliant: ingest: built-in:tiny: no frame lies")
    assert done.stdout == ""
    assert not (here / "part").exists()
    # Nor does it cost what is there.
    for name in ("trajectory.txt", "recording.mcap", "config.yaml", "notes"):
        (here / "result" / name).write_text("precious\n")
    before = {path: path.read_bytes() for path in here.rglob("*") if path.is_file()}
    done = in_this_process("run", TINY, *part, "--output", "result", "--force", cwd=here)
    assert_one_line(done, "built-in:tiny: no frame lies")
    after = {path: path.read_bytes() for path in here.rglob("*") if path.is_file()}
    assert after == before


def test_an_earlier_result_survives_a_mistake_with_force(here: Path) -> None:
    (here / "result" / "trajectory.txt").write_text("precious\n")
    endpoint = free_endpoint()
    with open_router(endpoint):
        port = endpoint.rsplit(":", 1)[1]
        done = in_this_process("run", here / "nan", "--output", "result", "--force", cwd=here)
        assert_one_line(done, "calib.yaml")
        write_sequence(here / "good", IMAGES)
        done = in_this_process(
            "run", here / "good", "--output", "result", "--force", "--port", port
        )
    assert_one_line(done, "in use")
    assert (here / "result" / "trajectory.txt").read_text() == "precious\n"


def test_output_without_a_reader_or_without_room() -> None:
    with subprocess.Popen(
        command("config"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()  # as `| head` does
        assert process.stderr.read() == ""
    assert process.returncode == 1
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command("config"), stdout=full, stderr=subprocess.PIPE, text=True)
    assert_one_line(done, "No space left")


def test_closed_standard_streams(tmp_path: Path) -> None:
    """A socket that got the number of stderr would get what libraries report."""
    run = ["run", TINY, "--output", tmp_path / "run", *NO_MESH]
    for arguments, closed in ((run, "<&- 2>&-"), (["config"], "<&- >&- 2>&-")):
        shell = ["sh", "-c", f'exec "$@" {closed}', "sh", *command(*arguments)]
        done = subprocess.run(shell, stdout=subprocess.PIPE, text=True, timeout=TIMEOUT_S)
        assert done.returncode == 0, closed
    assert (tmp_path / "run" / "trajectory.txt").exists()


def test_modules_of_the_current_folder_are_not_imported(tmp_path: Path) -> None:
    """The command does not import them, so neither do the processes that it starts."""
    for name in ("signal", "json", "numpy"):
        (tmp_path / f"{name}.py").write_text(f"raise SystemExit('{name}.py of the user')\n")
    run = [sys.executable, "-P", "-m", "pliant_services.cli", "run", TINY, "--output", "run"]
    done = subprocess.run([*run, *NO_MESH], cwd=tmp_path, capture_output=True, timeout=TIMEOUT_S)
    assert done.returncode == 0, done.stderr


# -- frames that are broken -----------------------------------------------------------------------


def test_broken_frames_are_counted_named_and_passed_over(tmp_path: Path) -> None:
    source = tmp_path / "source"
    shutil.copytree(builtin_folder(TINY), source)
    images = sorted((source / "images").iterdir())
    images[4].write_bytes(b"")
    images[6].write_bytes(images[6].read_bytes()[:2000])
    other = cv2.imread(str(images[8]))
    cv2.imwrite(str(images[8]), other[:-20])
    done = in_this_process("run", source, "--output", tmp_path / "result", *NO_MESH)
    assert done.returncode == 3, done.stderr
    report = json.loads((tmp_path / "result" / "report.json").read_text())
    assert report["frames"] == len(images)
    assert report["complete"]
    assert report["frames_with_pose"] >= len(images) - 3
    missing = report["frames_without_pixels"]
    assert sorted(missing) == ["4", "6", "8"]
    assert "empty" in missing["4"]
    assert "cut off" in missing["6"]
    assert "320x220 px, but the camera has 320x240" in missing["8"]
    assert report["counters"]["ingest"]["broken"] == 3
    (line,) = [line for line in done.stdout.splitlines() if " broken images: " in line]
    assert line.startswith("3 broken images: frame 4: ")


# -- runs that are cut short ----------------------------------------------------------------------


def test_sigterm_is_a_ctrl_c(tmp_path: Path) -> None:
    """As a container stops: the stream ends, and everything before is kept."""
    folder = tmp_path / "result"
    with running(TINY, "--output", folder, "--mode", "live", *NO_MESH) as run:
        run.wait_for(UP)
        run.send(signal.SIGTERM)
        code, output, _ = run.finish()
    assert code == 130
    assert "frames" in output
    report = json.loads((folder / "report.json").read_text())
    recorded = [m.sequence for m in Recording(folder / "recording.mcap").messages(topics.EXTREMA)]
    assert len(recorded) == report["frames"]


def test_a_second_ctrl_c_does_not_wait(tmp_path: Path) -> None:
    """A tracker that hangs keeps the stream from ending."""
    folder = tmp_path / "result"
    with running(TINY, "--output", folder, "--mode", "live", *NO_MESH) as run:
        run.wait_for(UP)
        run.wait_for_frames(folder)
        run.send(signal.SIGSTOP, "tracking")
        run.send(signal.SIGINT)
        run.wait_for("Ctrl-C again")
        run.send(signal.SIGINT)
        code, _, _ = run.finish()
    assert code == 130
    assert list(Recording(folder / "recording.mcap").messages(topics.STREAM))


def test_a_killed_recorder_is_named_and_its_recording_is_read(tmp_path: Path) -> None:
    folder = tmp_path / "result"
    # On the disk after every message, so that the first one is there whenever the signal comes.
    arguments = [TINY, "--output", folder, "--mode", "live", *NO_MESH, "--set"]
    with running(*arguments, "recorder.sync_interval_s=1e-9") as run:
        run.wait_for(UP)
        run.send(signal.SIGKILL, "recorder")
        code, _, errors = run.finish()
    assert code == 1
    assert errors.count("\n") == 1
    assert "recorder was killed by SIGKILL" in errors
    Recording(folder / "recording.mcap").metadata()


def test_services_end_when_their_launcher_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / "result"
    with running(TINY, "--output", folder, "--mode", "live", *NO_MESH) as run:
        run.wait_for(UP)
        run.send(signal.SIGKILL)
        left = [name for name, pid in run.services.items() if not has_ended(pid, 10.0)]
    assert set(run.services) >= set(PROFILES["points"])
    assert not left
    assert Recording(folder / "recording.mcap").metadata()["config"]


@pytest.fixture
def fleet(tmp_path: Path) -> Generator[Fleet]:
    fleet = Fleet(PROFILES["points"], log_folder=tmp_path, on_status=lambda _: None)
    yield fleet
    fleet.close()


def test_a_service_that_dies_during_the_start_is_named(fleet: Fleet, tmp_path: Path) -> None:
    def arguments(name: str) -> list[str]:
        if name == "bundle_adjustment":  # the last one: tracking has been started
            os.kill(fleet.pids["tracking"], signal.SIGKILL)
        if name == "ingest":
            return ["--source", TINY]
        return ["--output", str(tmp_path / "recording.mcap")] if name == "recorder" else []

    with pytest.raises(ServiceDiedError, match="tracking was killed by SIGKILL"):
        fleet.start(arguments)


def test_ctrl_c_during_the_start_leaves_no_process(fleet: Fleet, tmp_path: Path) -> None:
    def arguments(name: str) -> list[str]:
        if name == "bundle_adjustment":  # the last one
            raise KeyboardInterrupt
        if name == "ingest":
            return ["--source", TINY]
        return ["--output", str(tmp_path / "recording.mcap")] if name == "recorder" else []

    with pytest.raises(KeyboardInterrupt):
        fleet.start(arguments)
    pids = fleet.pids
    assert len(pids) == len(PROFILES["points"]) - 1
    fleet.close()
    assert all(has_ended(pid, 0.0) for pid in pids.values())


# -- disks that are full --------------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path: Path) -> Generator[Path]:
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("a small file system can be mounted by root only")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_is_named_and_what_was_written_is_read(small_disk: Path) -> None:
    folder = small_disk / "result"
    done = pliant("run", TINY, "--output", folder, *NO_MESH)
    assert done.returncode == 1
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("pliant: ")]
    assert str(folder) in line
    assert "the disk is full" in line
    assert "Traceback" not in done.stderr
    recorded = [m.decode().frame for m in Recording(folder / "recording.mcap").messages()]
    assert len(recorded) > 5
    assert not list(folder.glob(".partial-*"))
