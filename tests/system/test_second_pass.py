"""``pliant run --quality high``: what was lost is found from the other side."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from running import COARSE_MESH, NO_MESH, TINY, assert_one_line, digests, in_this_process

from pliant.datasets.builtin import builtin_folder
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import PliantError
from pliant.formats.tum import read_tum
from pliant.recording.map_file import MapFile
from pliant.recording.summary import SECOND_PASS, summarise
from pliant.results.folder import RECORDING_NAME
from pliant_services.run import second_pass as module
from pliant_services.run.request import RunRequest
from pliant_services.run.second_pass import is_better, second_pass

pytestmark = pytest.mark.system
LATE = 15
"""Frames that show nothing that lasts, in the first pass."""


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A source, and the result of a run when its first frames were noise."""
    room = tmp_path_factory.mktemp("late")
    source, output = room / "source", room / "result"
    shutil.copytree(builtin_folder(TINY), source)
    generator = np.random.default_rng(0)
    for path in sorted((source / "images").iterdir())[:LATE]:
        image = cv2.imread(str(path))
        assert image is not None
        cv2.imwrite(str(path), generator.integers(0, 256, image.shape[:2], np.uint8))
    done = in_this_process("run", source, *COARSE_MESH, "--output", output)
    assert done.returncode == 0, done.stderr
    shutil.copytree(builtin_folder(TINY) / "images", source / "images", dirs_exist_ok=True)
    return source, output


@pytest.fixture
def first(late: tuple[Path, Path], tmp_path: Path) -> tuple[RunRequest, Path]:
    output = Path(shutil.copytree(late[1], tmp_path / "result"))
    return RunRequest(
        source=SourceSpec(location=str(late[0])), output=output, quality="high"
    ), output


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_what_was_lost_at_the_beginning_is_found(
    first: tuple[RunRequest, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    request, output = first
    before, known = json.loads((output / "report.json").read_text()), contents(output)
    assert before["frames_with_pose"] == 40 - LATE
    (output / "trajectory_segment_7.txt").write_text("of a segment that is one with another now")
    assert second_pass(output, request, 0) == 0
    said = capsys.readouterr()
    assert "40 frames with a pose in 1 segment, in the first pass 25 frames" in said.err
    assert "all frames have a pose in one segment" in said.out
    report = json.loads((output / "report.json").read_text())
    assert report["frames_with_pose"] == report["frames"] == 40
    assert report["complete"]
    assert report["known_map"] is None
    assert report["coupling"] is None
    assert report["keyframes"] > before["keyframes"]
    assert report["mesh"][0]["keyframes"] > before["mesh"][0]["keyframes"]
    assert len(read_tum(output / "trajectory.txt")) == 40
    assert sum(1 for _ in MapFile(output).keyframes()) > report["keyframes"]
    assert contents(output).keys() == known.keys()  # nothing of the first stays, nothing beside it

    for services, same in ((), "tracks/extrema"), (("--services", "meshing"), "mesh/final"):
        done = in_this_process(
            "replay", output, "--check", *services, "--output", tmp_path / "r", "--force"
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert same in done.stdout
        assert ("two passes" in done.stderr) == (not services)
        metadata = summarise(tmp_path / "r" / RECORDING_NAME).metadata
        assert (SECOND_PASS in metadata) == bool(services)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), PliantError("no more"), MemoryError()])
@pytest.mark.parametrize("place", ["reach_back", "write_rigid_results"])
def test_the_first_result_stays_if_the_second_pass_fails(
    error: BaseException,
    place: str,
    first: tuple[RunRequest, Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    request, output = first
    before = contents(output)

    def ends(*_: object) -> None:
        raise error

    if place != "reach_back":
        monkeypatch.setattr(module, "_messages", lambda *_: ({}, {}))
        monkeypatch.setattr(module, "_record", lambda *_: None)
    monkeypatch.setattr(module, place, ends)
    assert second_pass(output, request, 0) == (130 if isinstance(error, KeyboardInterrupt) else 0)
    assert contents(output) == before
    assert "the result of the first pass is kept" in capsys.readouterr().err


def test_where_nothing_is_lost_the_first_result_is_the_best(tiny_run: Path, tmp_path: Path) -> None:
    done = in_this_process(
        "run", TINY, "--quality", "high", *NO_MESH, "--output", tmp_path / "tiny"
    )
    assert done.returncode == 0, done.stderr
    assert "second pass: no frame with image content was lost" in done.stderr
    assert digests(tmp_path / "tiny") == digests(tiny_run)


def test_what_comes_once_is_refused(tmp_path: Path) -> None:
    live = ("--quality", "high", "--mode", "live", "--output", tmp_path / "live")
    assert_one_line(in_this_process("run", TINY, *live), "reads a source twice")
    assert not (tmp_path / "live").exists()


def test_only_more_frames_under_no_worse_verdict_are_better() -> None:
    def report(posed: int, largest: int, verdict: str = "good") -> dict[str, object]:
        return {
            "frames_with_pose": posed, "verdict": verdict,
            "segments": [{"frames": largest}, {"frames": posed - largest}],
        }  # fmt: skip

    first = report(90, 60)
    assert not is_better(report(90, 60), first)
    assert is_better(report(91, 60), first)
    assert is_better(report(90, 90), first)
    assert not is_better(report(89, 89), first)
    assert not is_better(report(95, 59), first)
    assert not is_better(report(100, 100, "doubtful"), first)
