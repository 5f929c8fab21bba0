"""``pliant replay --services ... --processes``: as processes, fed over the bus by a player."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from pliant.config import Config
from pliant.recording.playback import Playback
from pliant.results.folder import CONFIG_NAME, RECORDING_NAME
from pliant_services.processes import BY_NAME, Process, inputs_of
from pliant_services.replay.player import Played, play, senders
from pliant_services.replay.services import affected
from pliant_services.run.progress import Progress
from pliant_services.runtime import kernels as warm_up
from pliant_services.runtime.host import observer_windows
from pliant_services.runtime.launcher import Fleet


def run_as_processes(
    recording: Path,
    services: Sequence[Process],
    config: Config,
    output: Path,
    metadata: Mapping[str, Mapping[str, str]],
) -> None:
    """Run services on a recording as in a live run, recorder included.  Raises PliantError."""
    playback = Playback(recording)
    out_of_date = affected(services)
    left_out = {topic for topic in playback.topics if topic.key in out_of_date}
    names = (*(process.name for process in services), "recorder")
    played = sorted(set(senders(playback.topics - left_out).values()) & BY_NAME.keys())
    whole = (*played, *names)
    readers = {
        topic: [r for r in names if topic in inputs_of(r, whole, images=config.recorder.images)]
        for name in names
        for topic in inputs_of(name, whole, images=config.recorder.images)
    }
    described = output / "logs" / "metadata.json"
    described.write_text(json.dumps(metadata), encoding="utf-8")

    def arguments(name: str) -> list[str]:
        extra = ["--config", str(output / CONFIG_NAME)]
        if name == "recorder":
            extra += ["--output", str(output / RECORDING_NAME), "--metadata", str(described)]
        return extra

    progress = Progress(None)
    warm_up.compile_kernels(progress.say)
    fleet = Fleet(names, log_folder=output / "logs", on_status=progress.on_status, elsewhere=played)
    try:
        with progress:
            fleet.start(arguments)
            play(
                playback,
                Played(readers=readers, left_out=left_out),
                endpoints=[fleet.endpoint],
                session=fleet.session,
                window=config.bus.window,
                windows=observer_windows(config, whole),
                wait_until=lambda _: True,
            )
            fleet.wait()
    finally:
        fleet.close()
