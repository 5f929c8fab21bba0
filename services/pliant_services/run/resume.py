"""Resuming an interrupted run: its original request, and how far it came."""

from collections.abc import Sequence
from pathlib import Path

from pliant.config import Config, load_config
from pliant.errors import ConfigError, ResultError
from pliant.recording import parts
from pliant.recording.map_file import MapFile
from pliant.recording.recover import mend
from pliant.recording.summary import summarise
from pliant.results.folder import CONFIG_NAME, RECORDING_NAME, REPORT_NAME, STATE_FOLDER
from pliant_services.processes import deformable_fleet, inputs_of
from pliant_services.profiles import PROFILES
from pliant_services.run.request import RunRequest

KNOWN_MAP = "known_map"
"""In the folder of checkpoints: the path of the map that the run extends."""
_NONE = "there is no run to resume: leave out --resume"
_OVER = "its run is complete, and there is nothing to resume: use --force to start again"
_CUT_OFF = (
    "its run was started without --on-crash restart, and cannot resume: `pliant recover` keeps "
    "the recording, --force starts again"
)


def resumed_config(output: Path, request: RunRequest) -> Config:
    """The configuration of the run that is taken up again.  Raises ResultError, ConfigError."""
    begun = parts.exists(output / RECORDING_NAME)
    if not (output / STATE_FOLDER).is_dir() and (not begun or (output / REPORT_NAME).exists()):
        raise ResultError(f"{output}: {_OVER if begun else _NONE}")
    try:
        kept = load_config(output / CONFIG_NAME)
    except ConfigError as error:
        raise ResultError(f"{error}; resume with the release that began, or start again") from None
    is_given = request.overrides or request.config_file or request.seed is not None
    if is_given and kept != load_config(request.config_file, request.overrides, seed=request.seed):
        raise ResultError(
            "--resume uses the configuration of its run, and this one differs: leave out "
            "--config, --set, --seed and other options that change it"
        )
    return kept


def resumed_map(output: Path, request: RunRequest) -> Path | None:
    """The map that the resumed run extends.  Raises ResultError for another one."""
    if not (output / STATE_FOLDER).is_dir():  # at most results are left to write
        return request.known
    note = output / STATE_FOLDER / KNOWN_MAP
    begun_in = Path(note.read_text("utf-8", "surrogateescape")) if note.is_file() else None
    if request.known is not None and MapFile(request.known).path.resolve() != begun_in:
        raise ResultError(
            f"--resume uses the map of its run, {begun_in or 'which has none'}, and "
            f"{request.known} is another one: leave out --map"
        )
    return begun_in


def has_ended(output: Path, services: Sequence[str], config: Config) -> bool:
    """Whether all messages of the services are recorded, and no service needs a restart."""
    path = output / RECORDING_NAME
    if path.is_file():
        ended = {key for key, topic in summarise(path).topics.items() if topic.end is not None}
    else:
        _, ended = mend(path)
    recorded = inputs_of("recorder", services, images=config.recorder.images)
    return ended >= {topic.key for topic in recorded}


def check_ended(output: Path, config: Config) -> None:
    """Raise ResultError if a run without checkpoints was not recorded to its end."""
    # It loads modules that a launcher does not need.
    from pliant.results.surfel_frames import has_surfels

    deformable = has_surfels(output / RECORDING_NAME)
    rigid = "rigid" if config.meshing.enabled else "points"
    services = PROFILES[deformable_fleet(config) if deformable else rigid]
    if not has_ended(output, services, config):
        raise ResultError(f"{output}: {_CUT_OFF}")
