"""``--quality high``: the source is read again, backwards, where the first pass was lost.

The first result is whole before that begins, and stays unless the second pass comes to a better
one: more frames that have a pose, or more of them in one segment, under a verdict that is no worse.
Then the recording of the first pass gets the result: its last messages of the map are of both
passes, and the mesh is made again.
"""

import json
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from pliant.algorithms.image.exposure import FLAWS
from pliant.algorithms.map_delta import KeyframeDelta, MapDelta
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.backwards import Reached, Stretch, final_update, lost_stretches, reach_back
from pliant.config import Config, load_config
from pliant.datasets import open_source
from pliant.errors import PliantError
from pliant.exit_codes import INTERRUPTED
from pliant.files import write_whole
from pliant.map_history import MapHistory
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import (
    WORLD_FRAME_ID,
    Header,
    Keyframe,
    MapKeyframe,
    MapUpdate,
    StreamEnd,
)
from pliant.recording.measured import imu_of
from pliant.recording.reader import Recording
from pliant.recording.summary import SECOND_PASS, summarise
from pliant.recording.writer import RecordingWriter
from pliant.results.folder import CONFIG_NAME, RECORDING_NAME, REPORT_NAME, replace_by
from pliant.results.judgement import BAD, DOUBTFUL, GOOD
from pliant.results.known_scale import UNSCALED
from pliant.results.run import Run, known_keyframes, read_run
from pliant.results.write import write_rigid_results
from pliant.staging import staging
from pliant.wording import counted
from pliant_services.processes import BY_NAME
from pliant_services.replay.services import affected, copied, record
from pliant_services.run.final_summary import print_summary
from pliant_services.run.request import RunRequest

_VERDICTS = (GOOD, DOUBTFUL, BAD)
_MESHING = BY_NAME["meshing"]
_LAST = (topics.MAP_FINAL, topics.KEYFRAME_FINAL, topics.MAP_KEPT)
"""The topics that the second pass publishes again."""


def second_pass(output: Path, request: RunRequest, code: int) -> int:
    """Try for a better result than the one in a folder that this process holds, and say what comes
    of it; returns the exit code of the run.

    code: of the first pass.
    """
    try:
        # In the unit of the recording, to which the second pass adds: not in metres.
        run = read_run(output / RECORDING_NAME, UNSCALED)
        stretches, why = what_is_lost(run)
        if why:
            _say(why)
            return code
        _say(_described(stretches))
        with staging(output) as folder:
            made = folder / "result"
            made.mkdir()
            config = load_config(output / CONFIG_NAME)
            write_whole(made / CONFIG_NAME, (output / CONFIG_NAME).read_bytes())
            messages, counters = _messages(output, request, config, run, stretches)
            _record(output / RECORDING_NAME, made / RECORDING_NAME, config, messages, counters)
            second, first = write_rigid_results(made), _report(output)
            if not is_better(second, first):
                _say(
                    f"it has {_posed(second)}, the first {_posed(first)}: the first result is kept"
                )
                return code
            replace_by(output, made)
        _say(f"{_posed(second)}, in the first pass {_posed(first)}")
        print_summary(output, second)
    except KeyboardInterrupt:
        _say("stopped: the result of the first pass is kept")
        return INTERRUPTED
    except (PliantError, OSError, MemoryError) as error:
        _say(f"{error}: the result of the first pass is kept")
    return code


def what_is_lost(run: Run) -> tuple[list[Stretch], str]:
    """Where a source is to be read backwards, or why nothing of it is."""
    history = run.history
    segments = {frame: segment for frame, (segment, _) in history.final().items()}
    if not segments:
        return [], "the first pass has no map"
    lost = [
        frame
        for frame, (_, reason) in history.states.items()
        if frame not in segments and frame not in run.missing and reason not in FLAWS
    ]
    if not lost and len(set(segments.values())) == 1:
        return [], "no frame with image content was lost: nothing to improve"
    stretches = lost_stretches(segments, history.stamps_ns)
    return stretches, "" if stretches else "no tracked frame follows the lost ones"


def is_better(second: dict[str, Any], first: dict[str, Any]) -> bool:
    """Whether a report has more frames with a pose, or more in one segment, and nothing that is
    worse.
    """
    more = [_counts(second)[n] - _counts(first)[n] for n in range(2)]
    worse = _VERDICTS.index(second["verdict"]) > _VERDICTS.index(first["verdict"])
    return not worse and min(more) >= 0 and max(more) > 0


def _counts(report: dict[str, Any]) -> tuple[int, int]:
    segments = [segment["frames"] for segment in report["segments"]]
    return report["frames_with_pose"], max(segments, default=0)


def _posed(report: dict[str, Any]) -> str:
    segments = counted(len(report["segments"]), "segment")
    return f"{counted(report['frames_with_pose'], 'frame')} with a pose in {segments}"


def _messages(
    output: Path, request: RunRequest, config: Config, run: Run, stretches: list[Stretch]
) -> tuple[dict[Topic, list[Header]], dict[str, float]]:
    """The last messages of the map, of both passes, and what inertial samples did."""
    dataset = open_source(request.source, config.ingest)
    recording = Recording(output / RECORDING_NAME)
    known: list[KeptKeyframe] = [
        keyframe
        for keyframe in recording.decoded(topics.MAP_KEPT)
        if isinstance(keyframe, MapKeyframe)
    ]
    samples = imu_of(recording)
    reached = reach_back(dataset, config, known, stretches, run.history, samples)
    (final,) = recording.decoded(topics.MAP_FINAL)
    (rest,) = recording.decoded(topics.KEYFRAME_FINAL)
    assert isinstance(final, MapUpdate)
    assert isinstance(rest, Keyframe)
    header = Header(frame=final.frame, stamp_ns=final.stamp_ns, frame_id=final.frame_id)
    update = _update(recording, final, run.history, reached)
    kept = [
        MapKeyframe.of(Header(frame=n, stamp_ns=0, frame_id=WORLD_FRAME_ID), each)
        for n, each in enumerate(reached.kept)
    ]
    messages: dict[Topic, list[Header]] = {
        topics.MAP_FINAL: [MapUpdate.of(header, update, frame_id=WORLD_FRAME_ID)],
        topics.KEYFRAME_FINAL: [_keyframes(rest, reached)],
        topics.MAP_KEPT: [*kept],
    }
    return messages, {n: v for n, v in reached.counters.items() if n.startswith("coupling_")}


def _update(
    recording: Recording, final: MapUpdate, after: MapHistory, reached: Reached
) -> MapDelta:
    before = MapHistory()
    for keyframe in known_keyframes(recording):
        before.know(keyframe)
    for update in recording.decoded(topics.MAP_UPDATE):
        assert isinstance(update, MapUpdate)
        before.apply(update, frame=update.frame, stamp_ns=update.stamp_ns)
    last = reached.last
    assert last is not None
    joined = [*map(tuple, final.joined.tolist()), *reached.joined]
    last = replace(last, joined=np.array(joined, np.int32).reshape(-1, 2))
    return final_update(before, after, last)


def _keyframes(rest: Keyframe, reached: Reached) -> Keyframe:
    """With the keyframes that reading backwards made."""
    made = dict(sorted(reached.keyframes.items()))
    pictured = {number: each for number, each in made.items() if each.jpeg}
    names = [field.name for field in fields(KeyframeDelta)]
    arrays = {name: getattr(rest, name) for name in names}
    counts = np.array([len(each.point_ids) for each in made.values()], np.int32)
    arrays["keyframe_ids"] = np.concatenate([rest.keyframe_ids, np.array(list(made), np.int64)])
    arrays["settled"] = np.concatenate([rest.settled, np.ones(len(made), np.bool_)])
    arrays["counts"] = np.concatenate([rest.counts, counts])
    arrays["point_ids"] = np.concatenate([rest.point_ids, *(e.point_ids for e in made.values())])
    arrays["points_px"] = np.concatenate([rest.points_px, *(e.points_px for e in made.values())])
    return replace(
        rest, **arrays,
        earlier_ids=(*rest.earlier_ids, *pictured),
        earlier_jpegs=(*rest.earlier_jpegs, *(each.jpeg for each in pictured.values())),
        earlier_masks=_masks(rest, [each.mask for each in pictured.values()]),
    )  # fmt: skip


def _masks(rest: Keyframe, made: list[bytes]) -> tuple[bytes, ...]:
    """Masks of all images, or none if no image has one."""
    before = rest.earlier_masks or (b"",) * len(rest.earlier_jpegs)
    masks = (*before, *made)
    return masks if any(masks) else ()


def _record(
    first: Path,
    path: Path,
    config: Config,
    messages: dict[Topic, list[Header]],
    counters: dict[str, float],
) -> None:
    """A recording with other last messages of the map, and with a mesh of it where it had one."""
    recording, summary = Recording(first), summarise(first)
    about = {"topics": " ".join(topic.key for topic in _LAST)}
    about |= {name: repr(float(value)) for name, value in counters.items()}
    metadata = {**summary.metadata, SECOND_PASS: about}
    stale = {topic.key for topic in _LAST} | affected([_MESHING])
    with RecordingWriter(path, metadata) as writer:
        copied(recording, summary, stale, writer)
        for topic, some in messages.items():
            _write(writer, topic, some)
        writer.sync()
        if any(topic.key in summary.topics for topic in _MESHING.outputs):
            made = Recording(path)
            inputs = {topic: made.decoded(topic) for topic in _MESHING.inputs}
            record(_MESHING, inputs, config, writer)


def _write(writer: RecordingWriter, topic: Topic, messages: list[Header]) -> None:
    """A topic whole, and its end, at the time that its messages have."""
    end = StreamEnd(
        frame=len(messages), stamp_ns=0, frame_id="", topic=topic.key, messages=len(messages),
        complete=True,
    )  # fmt: skip
    for number, message in enumerate([*messages, end]):
        writer.write(
            topic if number < len(messages) else topics.STREAM_END, codec.encode(message),
            sequence=number, log_time_ns=message.stamp_ns, publish_time_ns=message.stamp_ns,
        )  # fmt: skip


def _described(stretches: list[Stretch]) -> str:
    frames = sum(each.last - each.first + 1 for each in stretches)
    return f"reading {counted(frames, 'frame')} backwards, where the camera was lost"


def _report(output: Path) -> dict[str, Any]:
    return json.loads((output / REPORT_NAME).read_text(encoding="utf-8"))


def _say(line: str) -> None:
    print(f"second pass: {line}", file=sys.stderr, flush=True)
