"""One run from the command line: check, compile, launch, wait, write the results."""

import errno
import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from pliant import __version__
from pliant.config import Config, config_yaml, load_config
from pliant.datasets import open_source
from pliant.datasets.builtin import builtin_folder, is_builtin
from pliant.datasets.rectifier import Rectifier
from pliant.errors import PliantError, ResultError
from pliant.fusion.memory import check_voxel_sizes
from pliant.recording import parts
from pliant.recording.recover import mend
from pliant_services import warm_up
from pliant_services.ingest import DROPPED, plays_live
from pliant_services.launcher import Fleet
from pliant_services.mesh_afterwards import add_mesh
from pliant_services.mesh_check import WITH_MESH, choose_profile
from pliant_services.mesh_results import FILES as MESH_FILES
from pliant_services.processes import PROFILES, deformable_fleet, inputs_of, reads_depth
from pliant_services.progress import Progress
from pliant_services.results import CONFIG_NAME, RECORDING_NAME, write_results
from pliant_services.spectators import announced, check_viewer, viewer
from pliant_services.surfel_results import FILES as SURFEL_FILES
from pliant_services.surfel_results import (
    SURFELS_NAME,
    has_surfels,
    surfel_summary,
    write_surfel_results,
)

STATE_FOLDER = "state"
"""Checkpoints of the services, while a run goes on that may be started again."""
DONE, INCOMPLETE, INTERRUPTED = 0, 3, 130

_OUTPUT_FILES = (
    "trajectory.txt",
    "trajectory_causal.txt",
    "keyframes.txt",
    "points.ply",
    "report.json",
)
_DEFORMABLE = "deformable"
_VERSIONS = ("eclipse-zenoh", "mcap", "msgpack", "numba", "numpy", "opencv-python-headless")


@dataclass(frozen=True, kw_only=True)
class RunRequest:
    """What the user asked for."""

    source: str
    profile: str = "rigid"
    output: Path | None = None
    force: bool = False
    config_file: Path | None = None
    overrides: Sequence[str] = ()
    seed: int | None = None
    calibration: Path | None = None
    fov_deg: float | None = None
    topic: str = ""
    port: int | None = None
    view: Literal["window", "web"] | None = None
    save: Path | None = None
    on_crash: Literal["stop", "restart"] = "stop"
    resume: bool = False


def run_pipeline(request: RunRequest) -> int:
    """Run the pipeline; returns the exit code.  Raises PliantError for what the user can mend.

    Everything is checked before an earlier result is touched.
    """
    config = load_config(request.config_file, request.overrides, seed=request.seed)
    output = request.output or Path("results") / _folder_name(request.source)
    profile = request.profile
    state = output / STATE_FOLDER if request.on_crash == "restart" or request.resume else None
    if request.resume:
        config = resumed_config(output, request)
        profile = _DEFORMABLE if (output / STATE_FOLDER / "surfels").is_dir() else profile
    else:
        check_output(output, force=request.force)
    if request.view or request.save:
        check_viewer(output, web=request.view == "web", save=request.save, force=request.force)
    if is_builtin(request.source):
        builtin_folder(request.source, progress=_say_rendering)
    dataset = open_source(
        request.source,
        calibration=request.calibration,
        fov_deg=request.fov_deg,
        topic=request.topic,
        depth=config.ingest.depth if reads_depth(PROFILES[profile], config) else "none",
    )
    progress = Progress(dataset.frame_count)
    if profile == _DEFORMABLE:
        profile = deformable_fleet(config)
    else:
        profile, without_mesh = choose_profile(config)
        if without_mesh:
            progress.say(without_mesh)
        if profile == WITH_MESH:
            check_voxel_sizes(Rectifier(dataset.calibration).camera, config.meshing.tsdf)
    mesh_afterwards = state is not None and profile == WITH_MESH
    services = PROFILES["points" if mesh_afterwards else profile]
    if request.resume and _has_ended(output, services, config):
        progress.say("the run had come to its end already: what follows from it is written again")
        interrupted, failure = False, None
    else:
        if request.resume and plays_live(dataset, config):
            raise ResultError(
                f"{output} was recorded live, and what was passed over then would be others now: "
                f"`pliant run {output / RECORDING_NAME} --output ...` works on what was recorded"
            )
        fleet = Fleet(
            services,
            log_folder=output / "logs",
            on_status=progress.on_status,
            port=request.port,
            state=state,
        )
        interrupted, failure = _go_through(request, config, output, fleet, progress)
    if failure is None and mesh_afterwards and parts.exists(output / RECORDING_NAME):
        progress.say("meshing what was recorded ...")
        try:
            add_mesh(output)
        except KeyboardInterrupt:
            interrupted = True
        except PliantError as error:
            failure = error
    if failure is None and not interrupted:
        shutil.rmtree(output / STATE_FOLDER, ignore_errors=True)
    return _finish(output, interrupted=interrupted, failure=failure)


def _go_through(
    request: RunRequest, config: Config, output: Path, fleet: Fleet, progress: Progress
) -> tuple[bool, PliantError | None]:
    """Start the services and wait for their end: whether it was Ctrl-C, and what went wrong."""
    try:
        warm_up.compile_kernels(progress.say)  # whatever ends it, an earlier result is as it was
        if not request.resume:
            prepare(output, config_yaml(config))
        looking_on = (
            viewer(fleet, web=request.view == "web", save=request.save)
            if request.view or request.save
            else nullcontext()
        )
        try:
            with announced(output, fleet.endpoint, fleet.session), looking_on, progress:
                fleet.start(lambda name: service_arguments(name, request, output))
                progress.say(f"services are up; look on: pliant view {output}")
                return _wait(fleet, progress), None
        except KeyboardInterrupt:
            return True, None
        except PliantError as error:
            return False, error
    finally:
        fleet.close()


def resumed_config(output: Path, request: RunRequest) -> Config:
    """The configuration of the run that is taken up again.  Raises ResultError, ConfigError."""
    if not (output / STATE_FOLDER).is_dir():
        raise ResultError(
            f"{output} holds no run that can be resumed: start it with --on-crash restart"
        )
    if request.overrides or request.config_file or request.seed is not None:
        raise ResultError(
            "--resume takes the configuration of its run: leave --config, --set, --seed"
        )
    return load_config(output / CONFIG_NAME)


def _has_ended(output: Path, services: Sequence[str], config: Config) -> bool:
    """Whether all that the services had to say was recorded, and nobody is to be started again."""
    _, ended = mend(output / RECORDING_NAME)
    recorded = inputs_of("recorder", services, images=config.recorder.images)
    return ended >= {topic.key for topic in recorded}


def _wait(fleet: Fleet, progress: Progress) -> bool:
    """Wait for the end of the run; True if it was brought about by Ctrl-C."""
    try:
        fleet.wait()
    except KeyboardInterrupt:
        progress.say("stopping after the frame at hand (Ctrl-C again to kill)")
        fleet.end_source()
        fleet.wait()
        return True
    return False


def service_arguments(name: str, request: RunRequest, output: Path) -> list[str]:
    """What a service is told on its command line beside how to reach the others."""
    extra = ["--config", str(output / CONFIG_NAME)]
    if name == "ingest":
        extra += ["--source", request.source]
        extra += ["--calibration", str(request.calibration)] if request.calibration else []
        extra += ["--fov", str(request.fov_deg)] if request.fov_deg is not None else []
        extra += ["--topic", request.topic] if request.topic else []
    if name == "recorder":
        extra += ["--output", str(output / RECORDING_NAME)]
        extra += ["--metadata", str(output / "logs" / "metadata.json")]
    return extra


def _finish(output: Path, *, interrupted: bool, failure: PliantError | None) -> int:
    """Write what can be written of the recording, and say where it is; then raise the failure."""
    if not parts.exists(output / RECORDING_NAME):
        if failure is not None:
            raise failure
        raise KeyboardInterrupt if interrupted else ResultError(f"{output}: nothing was recorded")
    try:
        report = write_outputs(output)
    except PliantError:
        if failure is not None:  # it came first, and says why this one followed
            raise failure from None
        raise
    with suppress(BrokenPipeError):  # the results are on the disk, whoever reads of them
        for line in summary(report):
            print(line)
        files = [*_files(report), *(n for n in MESH_FILES if (output / n).exists())]
        print(f"results in {output}/: {', '.join(files)}, {_recording_in(output)}")
    if failure is not None:
        raise failure
    return INTERRUPTED if interrupted else grade(report)


def _recording_in(output: Path) -> str:
    """The recording of a result folder by its name there: a file, or a folder of parts."""
    path = output / RECORDING_NAME
    if path.is_file():
        return path.name
    count = len(parts.parts_of(path))
    return f"{parts.folder_of_parts(path).name}/ ({count} {'part' if count == 1 else 'parts'})"


def grade(report: dict[str, Any]) -> int:
    """The exit code of a run with this report."""
    whole = report["complete"] and not (_broken(report) or report["ended_early"])
    return DONE if report["segments"] and whole else INCOMPLETE


def write_outputs(output: Path) -> dict[str, Any]:
    """Write the files of a recording's profile; returns the report.  Raises PliantError."""
    deformable = has_surfels(output / RECORDING_NAME)
    return write_surfel_results(output) if deformable else write_results(output)


def _files(report: dict[str, Any]) -> tuple[str, ...]:
    return SURFEL_FILES if report.get("profile") == _DEFORMABLE else _OUTPUT_FILES


def _broken(report: dict[str, Any]) -> list[str]:
    """What is wrong with each broken image.  Those that live mode drops are no fault."""
    return [why for why in report["frames_without_pixels"].values() if why != DROPPED]


def summary(report: dict[str, Any], *, has_map: bool = True) -> list[str]:
    """The report in a few lines.  has_map: False where nobody was to make one, as in a replay."""
    if report.get("profile") == _DEFORMABLE:
        return [*surfel_summary(report), *_faults(report)]
    frames = report["frames"]
    if not has_map:
        median = f"median per frame: {report['median_tracks_per_frame']:.0f} tracks"
        return [f"{frames} frames, no map: bundle_adjustment was not replayed", median]
    lines = [
        f"{frames} frames at {report['frames_per_second']:.1f} frames/s, "
        f"{report['frames_with_pose']} with a pose ({100.0 * report['success_rate']:.1f} %), "
        f"{report['keyframes']} keyframes, {report['points']} points",
        f"median per frame: {report['median_tracks_per_frame']:.0f} tracks, "
        f"{report['median_inliers_per_frame']:.0f} mapped inliers",
    ]
    lines += [
        f"{mesh['level']} mesh: {mesh['triangles']} triangles from {mesh['keyframes']} keyframes"
        for mesh in report["mesh"]
        if mesh["level"] == "fine"
    ]
    lines += _faults(report)
    if not report["segments"]:
        lines.append(f"no map could start: {report['last_reason'] or 'no frames'}")
    elif len(report["segments"]) > 1:
        lines.append(f"the map was lost and restarted: {len(report['segments'])} segments")
    return lines


def _faults(report: dict[str, Any]) -> list[str]:
    """What was wrong with the frames."""
    lines: list[str] = []
    broken = _broken(report)
    dropped = len(report["frames_without_pixels"]) - len(broken)
    if dropped:
        lines.append(f"{dropped} images dropped to keep up (live mode)")
    passed_over = len(report.get("frames_passed_over", ()))
    if passed_over:
        lines.append(f"{passed_over} images tracked, but not mapped, to keep up (live mode)")
    if broken:
        first = broken[0].removeprefix("broken: ")
        lines.append(f"{len(broken)} broken {'image' if len(broken) == 1 else 'images'}: {first}")
    if report["ended_early"]:
        lines.append(f"the source ended early: {report['ended_early']}")
    return lines


def _say_rendering(what: str, done: int, total: int) -> None:
    if done == 0:
        print(f"built-in sequence, {what} (once) ...", file=sys.stderr)


def check_output(output: Path, *, force: bool) -> None:
    """Raise ResultError where the results cannot go there.  Changes nothing."""
    try:
        if output.exists() and not output.is_dir():
            raise ResultError(f"{output} is a file: choose another --output")
        if output.is_dir() and any(output.iterdir()) and not force:
            raise ResultError(
                f"{output} exists: choose another --output, or --force to overwrite it"
            )
        parent = next(folder for folder in (output, *output.parents) if folder.exists())
    except OSError as error:
        raise _unwritable(output, error) from None
    if not parent.is_dir():
        raise ResultError(f"{output}: {parent} is a file: choose another --output")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise ResultError(f"{output}: {parent} cannot be written to: choose another --output")


def prepare(output: Path, config: str) -> None:
    """Make the folder, free of earlier results, with what the services read."""
    try:
        (output / "logs").mkdir(parents=True, exist_ok=True)
        parts.remove(output / RECORDING_NAME)
        shutil.rmtree(output / STATE_FOLDER, ignore_errors=True)
        for name in (*_OUTPUT_FILES, *MESH_FILES, SURFELS_NAME):
            (output / name).unlink(missing_ok=True)
        for path in output.glob("*_segment_*"):
            path.unlink()
        (output / CONFIG_NAME).write_text(config, encoding="utf-8")
        metadata = json.dumps(run_metadata(config))
        (output / "logs" / "metadata.json").write_text(metadata, encoding="utf-8")
    except OSError as error:
        raise _unwritable(output, error) from None


def _unwritable(output: Path, error: OSError) -> ResultError:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return ResultError(
            f"{output}: the disk is full: free some space or choose another --output"
        )
    return ResultError(f"{output}: cannot be written ({error.strerror}): choose another --output")


def _folder_name(source: str) -> str:
    name = source.rstrip("/").rsplit("/", 1)[-1]
    if name in ("", ".", ".."):
        name = Path(source).resolve().name
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name) or "run"


def run_metadata(config: str) -> dict[str, dict[str, str]]:
    """What a recording says of how it was made."""
    return {
        "pliant": {
            "version": __version__,
            "commit": _commit(),
            "command": " ".join(sys.argv),
            "python": platform.python_version(),
            "host": platform.node(),
            "machine": f"{platform.system()} {platform.machine()}",
            "cpu_count": str(os.cpu_count()),
        },
        "packages": {name: version(name) for name in _VERSIONS},
        "config": {"yaml": config},
    }


def _commit() -> str:
    """The commit of the checkout that runs; "" for an installed package."""
    try:
        here = Path(__file__).parent
        command = ["git", "-C", str(here), "rev-parse", "HEAD"]
        return subprocess.run(command, capture_output=True, text=True, timeout=5).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
