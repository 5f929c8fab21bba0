"""Services killed in the middle of a run: the results are the same bytes as without the fault."""

import json
import re
import shutil
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from running import TINY, assert_one_line, digests, in_this_process
from watched_runs import REQUEST, SERVICES, TooLateError, run, run_attacked

from pliant.algorithms.map_delta import LOST, TRACKING, WAITING
from pliant.config import config_yaml, load_config
from pliant.datasets import open_source
from pliant.datasets.calibration import calibration_yaml
from pliant.datasets.recorded_images import RecordedImages
from pliant.datasets.rectifier import decode
from pliant.datasets.source_spec import SourceSpec
from pliant.datasets.video_decoder import quiet_opencv
from pliant.messages import topics
from pliant.messages.types import ClipPiece, MapUpdate, SourceImage, Status
from pliant.recording.reader import Recording
from pliant.recording.writer import RecordingWriter
from pliant.results.folder import RECORDING_NAME, STATE_FOLDER
from pliant_services.replay.command import SAME, ReplayRequest, run_replay
from pliant_services.run.request import RunRequest
from pliant_services.run.resume import resumed_config, resumed_map
from pliant_services.runtime import launcher
from pliant_services.runtime.launcher import Fleet, ServiceDiedError

pytestmark = pytest.mark.system

FRAMES = 40
_ATTEMPTS = 5


def run_until_killed(
    output: Path,
    *before: tuple[int, Sequence[str]],
    **options: Any,
) -> None:
    """A run all of whose services die with the launcher, past the middle.

    before: who is killed ahead of that, as of ``once_at``.
    So short a run may be over before that is told here: then again.
    """

    def attempt() -> None:
        victims = once_at(*before)

        def also_all(status: Status, fleet: Fleet) -> Sequence[str]:
            if status.service == "bundle_adjustment" and status.frame == 22:
                fleet.give_up()
                return SERVICES
            return victims(status, fleet)

        run(output, also_all, **options)

    for _ in range(_ATTEMPTS):
        shutil.rmtree(output, ignore_errors=True)
        try:
            attempt()
        except ServiceDiedError:
            return
    pytest.fail(f"{_ATTEMPTS} runs were over before they could be killed")


@pytest.fixture
def undisturbed(tiny_run: Path) -> dict[str, str]:
    """Of an ordinary run: neither checkpoints nor a mesher change what the others make."""
    return digests(tiny_run)


def once_at(*when: tuple[int, Sequence[str]]) -> Callable[[Status, Fleet], Sequence[str]]:
    """Kill these when bundle adjustment has told of a frame; frames rise."""
    waiting = list(when)

    def victims(status: Status, _: Fleet) -> Sequence[str]:
        if not waiting or status.service != "bundle_adjustment" or status.frame < waiting[0][0]:
            return ()
        return waiting.pop(0)[1]

    return victims


def test_killed_services_resume_where_they_were(
    tmp_path: Path, undisturbed: dict[str, str]
) -> None:
    """Each in its turn, early, before there is a checkpoint, and late."""
    killed: list[str] = []
    each = [(3 * i, (name,)) for i, name in enumerate(SERVICES)]
    kills = once_at(*((first + after, name) for first in (2, 16) for after, name in each))

    def victims(status: Status, fleet: Fleet) -> Sequence[str]:
        chosen = kills(status, fleet)
        killed.extend(chosen)
        return chosen

    assert run(tmp_path, victims) == undisturbed
    assert killed == 2 * list(SERVICES)


def test_all_at_once(
    tmp_path: Path, undisturbed: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether the launcher sees one dead and others alive, or, looking seldom, all dead."""
    monkeypatch.setattr(launcher, "_POLL_S", 0.01)
    kills, killed = once_at((8, SERVICES), (20, SERVICES)), list[str]()

    def victims(status: Status, fleet: Fleet) -> Sequence[str]:
        if status.service == "bundle_adjustment" and status.frame >= 14:
            monkeypatch.setattr(launcher, "_POLL_S", 1.0)
        chosen = kills(status, fleet)
        killed.extend(chosen)
        return chosen

    assert run(tmp_path, victims) == undisturbed
    assert killed == 2 * list(SERVICES)


def test_all_with_the_launcher_and_resume(tmp_path: Path, undisturbed: dict[str, str]) -> None:
    run_until_killed(tmp_path)
    resumed_config(tmp_path, REQUEST)
    assert run(tmp_path, resume=True) == undisturbed


def replayed(recorded: Path, output: Path, frames: int = FRAMES) -> dict[str, str]:
    """What the services make, undisturbed, of all frames of the source."""
    assert json.loads((recorded / "report.json").read_text())["frames"] == frames
    request = ReplayRequest(
        recording=recorded / RECORDING_NAME,
        services=("tracking", "bundle_adjustment"),
        output=output,
        check=True,
    )
    assert run_replay(request) == SAME
    return digests(output)


def in_map(known: Path) -> RunRequest:
    """A run that goes on in a map."""
    return RunRequest(source=SourceSpec(location=TINY), known=known)


@pytest.mark.slow
@pytest.mark.parametrize("localise", [False, True])
def test_all_with_the_launcher_and_resume_in_a_map(
    localise: bool, tmp_path: Path, tiny_run: Path
) -> None:
    """Also where the frames are only localised."""
    settings = ["bundle_adjustment.only_localise=true"] if localise else []

    request = in_map(tiny_run)
    run_until_killed(tmp_path / "cut", request=request, settings=settings)
    again = run(tmp_path / "cut", resume=True, request=request, settings=settings)
    assert again == replayed(tmp_path / "cut", tmp_path / "whole")


def test_a_run_is_taken_up_in_its_own_map(tmp_path: Path, tiny_run: Path) -> None:
    (tmp_path / "cut" / STATE_FOLDER).mkdir(parents=True)
    (tmp_path / "cut" / "config.yaml").write_text(config_yaml(load_config()))
    refused = in_this_process(
        "run", TINY, "--resume", "--map", tiny_run, "--output", tmp_path / "cut"
    )
    assert_one_line(refused, "which has none")
    note = tmp_path / "cut" / STATE_FOLDER / "known_map"
    note.write_text(str(tiny_run / "map.pliant"))
    assert (
        resumed_map(tmp_path / "cut", RunRequest(source=SourceSpec(location=TINY)))
        == tiny_run / "map.pliant"
    )
    assert resumed_map(tmp_path / "cut", in_map(tiny_run)) == tiny_run / "map.pliant"
    note.write_text(str(tmp_path / "gone" / "map.pliant"))
    refused = in_this_process("run", TINY, "--resume", "--output", tmp_path / "cut")
    assert_one_line(refused, "no map: pass")


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> RunRequest:
    """A video of the built-in sequence."""
    file = tmp_path_factory.mktemp("clip") / "clip.avi"
    frames = list(open_source(TINY))
    with quiet_opencv():
        writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (320, 240))
    if not writer.isOpened():
        pytest.skip("OpenCV cannot write a video here")
    for frame in frames:
        writer.write(cv2.cvtColor(decode(frame), cv2.COLOR_GRAY2BGR))
    writer.release()
    calibration = file.with_suffix(".yaml")
    calibration.write_text(calibration_yaml(open_source(TINY).calibration))
    return RunRequest(source=SourceSpec(location=str(file)))


def test_the_recording_of_a_video_has_all_images_after_any_kill(
    tmp_path: Path, clip: RunRequest
) -> None:
    """The ingest and the recorder, early and late, then all with the launcher, and a resume."""
    when = (1, ("ingest",)), (7, ("recorder",)), (14, ("recorder", "ingest"))
    run_until_killed(tmp_path / "cut", *when, request=clip)
    resumed_config(tmp_path / "cut", clip)
    again = run(tmp_path / "cut", resume=True, request=clip)
    assert again == replayed(tmp_path / "cut", tmp_path / "whole")
    recording = Recording(tmp_path / "cut")
    stored = [m for m in recording.decoded(topics.SOURCE) if isinstance(m, SourceImage)]
    assert not any(image.data for image in stored)
    made = [image.data for image in RecordedImages(recording)]
    assert made == [frame.data for frame in open_source(clip.source)]
    pieces = [m for m in recording.decoded(topics.CLIP) if isinstance(m, ClipPiece)]
    assert b"".join(piece.data for piece in pieces) == Path(clip.source.location).read_bytes()


@pytest.fixture(scope="module")
def torn(tmp_path_factory: pytest.TempPathFactory) -> RunRequest:
    """The left half of a scene, the dark, its right half, and then the whole of it: a map that is
    lost, another one, and what shows that they are one."""
    folder = tmp_path_factory.mktemp("torn")
    source = open_source(TINY)
    images = [decode(frame) for frame in source]
    middle = images[0].shape[1] // 2
    left, right = (np.zeros_like(images[0]) for _ in range(2))
    left[:, :middle], right[:, middle:] = 1, 1
    shown = [image * left for image in images[:14]] + [0 * left] * 6
    shown += [image * right for image in images[18:32]] + images[31::-1]
    for number, image in enumerate(shown):
        cv2.imwrite(str(folder / f"{number:03}.png"), image)
    (folder / "calib.yaml").write_text(calibration_yaml(source.calibration))
    return RunRequest(source=SourceSpec(location=str(folder)))


def test_bundle_adjustment_is_killed_after_a_loss_and_while_maps_become_one(
    tmp_path: Path, torn: RunRequest
) -> None:
    """While it waits for another map, and while the loop between the two is being closed."""
    at, killed = (22, 58), list[int]()
    kills = once_at(*((frame, ("bundle_adjustment",)) for frame in at))

    def victims(status: Status, fleet: Fleet) -> Sequence[str]:
        chosen = kills(status, fleet)
        killed.extend(status.frame for _ in chosen)
        return chosen

    settings = ["bundle_adjustment.localisation.max_lost_s=0.1"]
    found = run(tmp_path / "run", victims, request=torn, settings=settings)
    assert len(killed) == len(at)
    updates = Recording(tmp_path / "run").decoded(topics.MAP_UPDATE)
    said = {m.frame: m for m in updates if isinstance(m, MapUpdate)}
    assert [said[frame].state for frame in (14, *at)] == [LOST, WAITING, TRACKING]
    (joined,) = (m.frame for m in said.values() if len(m.joined))
    assert 34 < joined < at[-1]  # the loop's answer is taken over later
    assert found == replayed(tmp_path / "run", tmp_path / "whole", frames=66)


def test_a_live_run_is_not_resumed_but_its_recording_is_a_source(
    tmp_path: Path, tiny_run: Path
) -> None:
    """Other frames would be passed over, which some services saw already and others did not."""
    whole = Recording(tiny_run / "recording.mcap")
    (tmp_path / "state").mkdir()
    with RecordingWriter(tmp_path / "recording.mcap", whole.metadata()) as half:  # of its frames
        half.attach("calibration.yaml", "text/yaml", whole.attachments()["calibration.yaml"])
        for topic in (topics.STREAM, topics.SOURCE):
            for n, each in enumerate(islice(whole.messages(topic), 20)):
                half.write(topic, each.data, sequence=n, log_time_ns=n, publish_time_ns=n)
    (tmp_path / "config.yaml").write_text(config_yaml(load_config(overrides=["ingest.mode=live"])))
    refused = in_this_process("run", TINY, "--resume", "--output", tmp_path)
    assert_one_line(refused, "was recorded live")
    said = refused.stderr[refused.stderr.index("`pliant run ") + 1 :].split()[1:3]
    again = in_this_process(*said, "--output", tmp_path / "again", "--set", "meshing.enabled=false")
    assert again.returncode == 3, again.stderr  # as incomplete as the recording
    assert "frames at" in again.stdout


def test_messages_that_no_service_sends_are_counted_reported_and_change_nothing(
    tmp_path: Path, undisturbed: dict[str, str], tiny_run: Path
) -> None:
    """To every key, also under the numbers of the true ones, while the source is held up."""
    # A run of so few frames may be over before anybody can hold up its source: then again.
    for attempt in range(_ATTEMPTS):
        output = tmp_path / str(attempt)
        output.mkdir()
        try:
            found = run_attacked(output, tiny_run / "recording.mcap", each=300)
            break
        except TooLateError:
            continue
    else:
        pytest.fail(f"{_ATTEMPTS} runs were over before they could be attacked")
    assert found == undisturbed
    for name in ("tracking", "bundle_adjustment", "recorder"):
        said = (output / "logs" / f"{name}.log").read_text()
        assert "ignored messages" in said, name
        assert "refused" in said, name
    # Its last frame may pass before the last of them: it reports the credits that came before.
    assert re.search(r"credit of \S+ \d+ refused", (output / "logs" / "ingest.log").read_text())


DEADLY = """
import os, signal, sys

if "tracking" in sys.orig_argv:
    from pliant.algorithms.tracking.tracker import ExtremaTracker

    track = ExtremaTracker.track

    def track_or_die(self, grey, stamp_ns, *more, **named):
        if stamp_ns >= {stamp_ns}:
            os.kill(os.getpid(), signal.SIGKILL)
        return track(self, grey, stamp_ns, *more, **named)

    ExtremaTracker.track = track_or_die
"""


def test_a_frame_that_kills_again_and_again_ends_the_run_with_its_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From inside: a signal of ours would find the service a few frames further, each time others.

    What it said of the last frame may be lost with it.
    """
    twelfth = next(islice(open_source(TINY), 12, None))
    customised = tmp_path / "site"
    customised.mkdir()
    text = DEADLY.format(stamp_ns=twelfth.stamp_ns)
    (customised / "sitecustomize.py").write_text(text, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(customised))
    with pytest.raises(ServiceDiedError, match=r"frame 1[0-2] killed tracking 3 times"):
        run(tmp_path / "result")
