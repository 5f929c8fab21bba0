"""Behind ``pliant replay``: from a result folder to a new one, with a comparison."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from pliant.config import config_yaml, recorded_config
from pliant.errors import RecordingError
from pliant.messages import topics
from pliant.messages.topics import Topic
from pliant.recording.compare import check_tolerances, compare
from pliant.recording.parts import parts_of
from pliant.recording.reader import Recording
from pliant.recording.summary import SECOND_PASS, summarise
from pliant.results import earlier
from pliant.results.folder import (
    RECORDING_NAME,
    keep_apart,
    let_go,
    prepare,
    run_metadata,
    written,
)
from pliant.results.verdict import summary
from pliant.results.write import write_results
from pliant.wording import counted
from pliant_services.replay.services import (
    Replay,
    gaps,
    recorded_services,
    replayable,
    require_inputs,
)

SAME, DIFFERENT = 0, 1
Metadata: TypeAlias = Mapping[str, Mapping[str, str]]


@dataclass(frozen=True, kw_only=True)
class ReplayRequest:
    """The request of a user."""

    recording: Path
    services: Sequence[str]  # without any, all that were recorded
    output: Path | None = None
    force: bool = False
    overrides: Sequence[str] = ()
    check: bool = False
    tolerances: Mapping[str, float] = field(default_factory=dict[str, float])


def comparable(made: Sequence[Topic], mode: str, metadata: Metadata) -> list[Topic]:
    """Topics that must be equal: not the live mesh of live mode, which depends on time, and of two
    passes only the first, which a replay repeats."""
    other = {topics.MESH_BLOCKS.key} if mode == "live" else set[str]()
    if topics.MAP_FINAL in made:
        other |= set(metadata.get(SECOND_PASS, {}).get("topics", "").split())
        other |= {topics.MESH_FINAL.key} if SECOND_PASS in metadata else set()
    return [topic for topic in made if topic.key not in other]


def run_replay(request: ReplayRequest) -> int:
    """Replay, write the results, compare; returns the exit code.  Raises PliantError."""
    folder = request.recording.resolve().parent
    output = request.output or folder.with_name(f"{folder.name}_replay")
    keep_apart(output, [request.recording, *parts_of(request.recording)])
    with written(output, force=request.force):
        return _replay_into(output, request)


def _replay_into(output: Path, request: ReplayRequest) -> int:
    recorded = summarise(request.recording)
    services = replayable(request.services or recorded_services(recorded))
    if not recorded.has_index:
        raise RecordingError(f"{request.recording}: not closed: use `pliant recover` to repair it")
    config = recorded_config(recorded.metadata, request.overrides)
    require_inputs(recorded, services)
    replay = Replay(request.recording, recorded, services, config)
    check_tolerances(replay.made, request.tolerances)
    prepare(output, config_yaml(config))
    metadata = run_metadata(config_yaml(config))
    metadata["replay"] = {
        "of": str(request.recording),
        "services": ",".join(s.name for s in services),
    }
    for line in gaps(recorded, services):
        print(line, file=sys.stderr)
    if SECOND_PASS in recorded.metadata:
        if topics.MAP_FINAL in replay.made:
            line = f"{request.recording} has two passes: the replay makes the first"
            print(line, file=sys.stderr)
        else:
            metadata[SECOND_PASS] = recorded.metadata[SECOND_PASS]
    replay.run(output / RECORDING_NAME, metadata)
    report = write_results(output)
    if earlier.is_aside(output):
        let_go(output)
    has_map = topics.MAP_UPDATE in replay.made or topics.MAP_UPDATE.key not in replay.affected
    for line in summary(report, has_map=has_map):
        print(line)
    print(f"results in {output}/")
    if not request.check:
        return SAME
    compared = comparable(replay.made, report["mode"], recorded.metadata)
    differences = compare(
        Recording(request.recording),
        Recording(output / RECORDING_NAME),
        compared,
        request.tolerances,
    )
    for difference in differences:
        print(
            f"{difference.topic} differs in {counted(difference.messages, 'message')}, "
            f"first {difference.first}"
        )
    if not differences:
        keys = ", ".join(topic.key for topic in compared)
        how = "the same within the tolerances" if request.tolerances else "the same bytes"
        print(f"{how} as recorded: {keys}")
        return SAME
    before, now = (
        {**found.get("arithmetic", {}), **found.get("packages", {})}
        for found in (recorded.metadata, metadata)
    )
    for name in sorted(before.keys() & now.keys()):
        if before[name] != now[name]:
            print(f"recorded with {name} {before[name]}, this is {now[name]}")
    return DIFFERENT
