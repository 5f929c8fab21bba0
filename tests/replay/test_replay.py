"""Services alone on a recorded run: the same bytes, or a readable first difference."""

import json
from pathlib import Path

import pytest
from running import COARSE_MESH, NO_MESH, TINY, assert_one_line, in_this_process, pliant

from pliant.config import config_yaml, load_config, recorded_config
from pliant.errors import ConfigError, RecordingError
from pliant.messages import topics
from pliant.messages.topics import Topic, by_key
from pliant.messages.types import SourceImage, StreamEnd
from pliant.recording.compare import compare
from pliant.recording.reader import Recording
from pliant.recording.summary import summarise
from pliant.recording.writer import RecordingWriter
from pliant_services.replay.command import DIFFERENT, SAME, ReplayRequest, run_replay
from pliant_services.replay.services import replayable

pytestmark = pytest.mark.system

PIPELINE = ["tracking", "bundle_adjustment"]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded") / "tiny"
    done = pliant("run", f"{TINY}?frames=12", "--output", folder, "--set", "seed=3", *COARSE_MESH)
    assert (folder / "recording.mcap").exists(), done.stderr
    return folder


def replay(result: Path, output: Path, *services: str, overrides: tuple[str, ...] = ()) -> int:
    request = ReplayRequest(
        recording=result / "recording.mcap",
        services=services,
        output=output,
        overrides=overrides,
        check=True,
    )
    return run_replay(request)


def test_a_run_over_a_link_with_jpegs_records_them_and_a_replay_makes_the_same_of_them(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "jpegs"
    settings = ("--set", "bus.link_images=jpeg", "--set", "bus.jpeg_quality=80", *NO_MESH)
    done = pliant("run", f"{TINY}?frames=12", "--output", folder, *settings)
    assert done.returncode == 0, done.stderr
    sources = list(Recording(folder / "recording.mcap").decoded(topics.SOURCE))
    assert {(s.encoding, s.made_from) for s in sources if isinstance(s, SourceImage)} == {
        ("jpeg", "png, quality 80")
    }
    assert (
        recorded_config(summarise(folder / "recording.mcap").metadata, ()).bus.link_images == "jpeg"
    )
    assert replay(folder, tmp_path / "again", *PIPELINE) == SAME


@pytest.mark.parametrize("services", [PIPELINE[:1], PIPELINE[1:], PIPELINE], ids="+".join)
def test_the_same_bytes(
    result: Path, tmp_path: Path, services: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert replay(result, tmp_path / "again", *services) == SAME
    printed = capsys.readouterr().out
    assert "the same bytes as recorded" in printed
    assert ("no map: bundle_adjustment was not replayed" in printed) == (services == ["tracking"])
    assert "no map could start" not in printed
    made = summarise(tmp_path / "again" / "recording.mcap")
    assert made.complete
    assert made.missing == 0
    assert made.metadata["replay"]["services"] == ",".join(services)
    assert ("map/update" in made.topics) == ("bundle_adjustment" in services)  # nothing stale
    assert made.topics["camera/source"].messages == 12
    if "bundle_adjustment" in services:
        before = json.loads((result / "report.json").read_text())
        after = json.loads((tmp_path / "again" / "report.json").read_text())
        assert after["points"] == before["points"]
        assert after["frames"] == before["frames"] == 12


def test_a_replay_can_be_replayed(result: Path, tmp_path: Path) -> None:
    assert replay(result, tmp_path / "first", *PIPELINE) == SAME
    assert replay(tmp_path / "first", tmp_path / "second", "bundle_adjustment") == SAME


def test_a_changed_parameter_is_named_by_what_it_changes_first(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = ("tracking.max_tracks=300",)
    assert replay(result, tmp_path / "other", "tracking", overrides=changed) == DIFFERENT
    said = capsys.readouterr().out
    assert "tracks/extrema differs in 12 messages, first frame 0: ids: shape (300,), was" in said


def test_the_recorded_configuration_is_the_default(result: Path) -> None:
    summary = summarise(result / "recording.mcap")
    assert recorded_config(summary.metadata, []) == load_config(None, ["seed=3", COARSE_MESH[1]])
    assert recorded_config(summary.metadata, ["seed=4"]).seed == 4
    assert config_yaml(recorded_config(summary.metadata, [])) == summary.metadata["config"]["yaml"]
    with pytest.raises(ConfigError):
        recorded_config(summary.metadata, ["nothing.such=1"])


def test_only_services_that_read_can_be_replayed() -> None:
    assert [p.name for p in replayable(["bundle_adjustment", "tracking"])] == PIPELINE
    for wrong in (["ingest"], ["recorder"], ["nothing"], []):
        with pytest.raises(RecordingError, match="choose from tracking"):
            replayable(wrong)


def test_a_recording_cut_off_is_recovered_and_then_replays(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "cut"
    folder.mkdir()
    content = (result / "recording.mcap").read_bytes()
    seventh = list(Recording(result / "recording.mcap").messages(topics.SOURCE))[6]
    cut = content.index(seventh.data) + 100  # in the middle of its image
    (folder / "recording.mcap").write_bytes(content[:cut])
    with pytest.raises(RecordingError, match="pliant recover"):
        replay(folder, tmp_path / "never", "tracking")
    done = pliant("recover", folder)
    assert done.returncode == 0, done.stderr
    assert "messages kept" in done.stdout
    request = ReplayRequest(
        recording=folder / "recording_recovered.mcap",
        services=["tracking"],
        output=tmp_path / "made",
    )
    assert run_replay(request) == SAME
    frames = len(list(Recording(tmp_path / "made" / "recording.mcap").messages(topics.EXTREMA)))
    recorded = Recording(result / "recording.mcap")
    assert frames == 6
    found = compare(recorded, Recording(tmp_path / "made" / "recording.mcap"), [topics.EXTREMA])
    assert [d.kind for d in found] == ["count"]  # as far as it goes it is the same


def test_what_cannot_be_replayed_is_one_line(result: Path, tmp_path: Path) -> None:
    assert_one_line(in_this_process("replay", tmp_path / "none.mcap"), "no such recording")
    assert_one_line(in_this_process("replay", result, "--output", result), "is read from there")
    assert_one_line(
        in_this_process("replay", result, "--check", "--loop"), "--loop applies to playing", 2
    )


def without(result: Path, output: Path, *left_out: Topic, frame: int | None = None) -> Path:
    """A copy of a recording that lacks topics, or one frame of them."""
    whole = Recording(result / "recording.mcap")
    output.mkdir()
    with RecordingWriter(output / "recording.mcap", whole.metadata()) as writer:
        for message in whole.messages():
            about = message.topic
            if about == topics.STREAM_END and frame is None:
                end = message.decode()
                assert isinstance(end, StreamEnd)
                about = by_key(end.topic)
            if about not in left_out or frame not in (None, message.sequence):
                message.write_to(writer)
    return output


def test_what_reads_no_images_is_replayed_without_them(result: Path, tmp_path: Path) -> None:
    if "mesh/final" not in summarise(result).topics:
        pytest.skip("no mesh was made here")
    small = without(result, tmp_path / "small", topics.SOURCE, topics.DEPTH)
    assert replay(small, tmp_path / "again", "meshing") == SAME
    with pytest.raises(RecordingError, match="--no-images"):
        replay(small, tmp_path / "never", "tracking")


def test_what_is_missing_of_the_inputs_is_said(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gap = without(result, tmp_path / "gap", topics.SOURCE, frame=5)
    assert replay(gap, tmp_path / "again", "tracking") == DIFFERENT
    assert "camera/source lacks 1 of its messages" in capsys.readouterr().err
    part = without(result, tmp_path / "part", topics.STREAM)
    with pytest.raises(RecordingError, match=r"without camera/stream .*one part of several"):
        replay(part, tmp_path / "never", "tracking")
