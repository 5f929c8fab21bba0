"""One run from the command line: check, compile, launch, wait, write the results."""

import math
import os
import shutil
import sys
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path

from pliant.config import Config, config_yaml, load_config
from pliant.datasets import check_start, notes_on, open_source
from pliant.datasets.base import is_builtin
from pliant.datasets.calibration import Calibration
from pliant.datasets.calibration_files import file_and_camera
from pliant.datasets.calibration_formats import UNDERSTOOD
from pliant.datasets.measured.found import measurements_of
from pliant.datasets.rectifier import Rectifier
from pliant.errors import CalibrationError, DatasetError, PliantError, ResultError
from pliant.exit_codes import INTERRUPTED
from pliant.files import make_folder, write_whole
from pliant.fusion.memory import check_voxel_sizes
from pliant.messages.types import Status
from pliant.recording import parts
from pliant.recording.map_file import MapFile
from pliant.results import earlier
from pliant.results.folder import (
    CONFIG_NAME,
    RECORDING_NAME,
    STATE_FOLDER,
    discard,
    files_read,
    folder_name,
    has_frames,
    keep_apart,
    let_go,
    prepare,
    settle_killed,
    written,
)
from pliant.results.locking import Held
from pliant_services.nodes.ingest import plays_live
from pliant_services.processes import BY_NAME, deformable_fleet, with_depth
from pliant_services.profiles import PROFILES
from pliant_services.run.final_summary import print_summary
from pliant_services.run.progress import Progress
from pliant_services.run.request import RunRequest
from pliant_services.run.resume import (
    KNOWN_MAP,
    check_ended,
    has_ended,
    resumed_config,
    resumed_map,
)
from pliant_services.run.spectators import Viewer, check_viewer, has_viewer
from pliant_services.runtime import kernels as warm_up
from pliant_services.runtime.announced import announced
from pliant_services.runtime.fork_server import ForkServer
from pliant_services.runtime.launcher import Fleet, ServiceDiedError
from pliant_services.runtime.limits import check_limits

_DEFORMABLE = "deformable"
_WRITTEN_AGAIN = "the run was already complete: its results are written again"


def run_pipeline(request: RunRequest, server: ForkServer | None = None) -> int:
    """Run the pipeline; returns the exit code.  Raises PliantError for what the user can mend.

    server: forks the services, and imports what they need while this process checks the source.

    Everything is checked before an earlier result is touched.
    """
    check_limits()
    source = request.source
    output = request.output or Path("results") / folder_name(source.location)
    place = Path(source.location)
    read = [place, *parts.parts_of(place)] if os.path.exists(source.location) else []
    if request.resume:
        settle_killed(output)
        request = replace(request, known=resumed_map(output, request))
    known = None if request.known is None else MapFile(request.known)
    if known is not None:
        read.append(known.path)
    # The configuration is read before anything is deleted: it may be in this folder.
    read += [source.mask] if source.mask is not None else []
    read += [Path(name) for name in (source.imu, source.gps) if name and os.path.exists(name)]
    read += [file_and_camera(source.calibration)[0]] if source.calibration is not None else []
    keep_apart(output, read)
    if request.save is not None:
        keep_apart(request.save, [*read, *files_read(output)], option="--save")
    web, looked_on = request.view == "web", bool(request.view or request.save)
    with Viewer(web=web, save=request.save) if looked_on else nullcontext() as viewer:
        if known is not None:
            for _ in known.keyframes():  # said before anything is touched
                pass
        with written(output, force=request.force or request.resume) as held:
            if request.resume and not (output / STATE_FOLDER).is_dir():
                check_ended(output, resumed_config(output, request))
                print(_WRITTEN_AGAIN, file=sys.stderr, flush=True)
                code = _finish(output, interrupted=False, failure=None, resumed=True)
            else:
                code = _run_into(output, request, viewer, held, server)
            if request.quality == "high" and code != INTERRUPTED and held.path is not None:
                from pliant_services.run.second_pass import second_pass  # it maps in this process

                code = second_pass(held.path, request, code)
        if viewer is not None and code != INTERRUPTED:
            viewer.stay()  # the results are there
        return code


def _run_into(
    output: Path,
    request: RunRequest,
    viewer: Viewer | None,
    held: Held,
    server: ForkServer | None,
) -> int:
    config = load_config(request.config_file, request.overrides, seed=request.seed)
    profile = request.profile
    state = output / STATE_FOLDER if request.on_crash == "restart" or request.resume else None
    if request.resume:
        config = resumed_config(output, request)
        profile = _DEFORMABLE if (output / STATE_FOLDER / "surfels").is_dir() else profile
    if request.view or request.save:
        check_viewer(output, web=request.view == "web", save=request.save, force=request.force)
    spec = with_depth(request.source, PROFILES[profile], config)
    if is_builtin(spec.location):
        from pliant.datasets.builtin import builtin_folder  # other sources need none

        builtin_folder(spec.location, progress=_report_rendering)
    dataset = open_source(spec, config.ingest.model_copy(update={"mask_static": False}))
    check_start(dataset)
    if request.quality == "high" and plays_live(dataset, config):
        raise DatasetError(
            f"{spec.location}: --quality high reads a source twice, which a live source does not "
            "allow: leave it out, and use it on the recording"
        )
    if request.force and not dataset.is_live:
        next(iter(dataset), None)  # without a first frame an earlier result stays
    progress = Progress(dataset.frame_count)
    for note in (*notes_on(dataset), *measurements_of(request.source, dataset).notes):
        progress.say(note)
    if spec.calibration is None and spec.fov_deg is None:
        _report_guess(dataset.calibration, profile, progress)
    if profile == _DEFORMABLE:
        profile = deformable_fleet(config)
    else:
        profile = "rigid" if config.meshing.enabled else "points"
        if profile == "rigid":
            check_voxel_sizes(Rectifier(dataset.calibration).camera, config.meshing.tsdf)
    mesh_afterwards = state is not None and profile == "rigid"
    services = PROFILES["points" if mesh_afterwards else profile]
    if request.resume and has_ended(output, services, config):
        progress.say(_WRITTEN_AGAIN)
        interrupted, failure = False, None
    else:
        if request.resume and plays_live(dataset, config):
            raise ResultError(
                f"{output} was recorded live, and a resumed run would skip other frames: `pliant "
                f"run {output / RECORDING_NAME} --output ...` uses the recorded frames"
            )
        fleet = Fleet(
            services,
            log_folder=output / "logs",
            on_status=_Followed(output, progress).on_status,
            port=request.port,
            state=state,
            server=server,
        )
        interrupted, failure = _go_through(request, config, output, fleet, progress, viewer)
        output = _where_now(output, held, failure, progress)
    if failure is None and mesh_afterwards and parts.exists(output / RECORDING_NAME):
        progress.say("meshing the recording ...")
        from pliant_services.mesh.afterwards import add_mesh  # it loads what else replays

        try:
            add_mesh(output)
        except KeyboardInterrupt:
            interrupted = True
        except PliantError as error:
            failure = error
    code = _finish(output, interrupted=interrupted, failure=failure, resumed=request.resume)
    if not interrupted:  # the results are on the disk: nothing is left to resume
        shutil.rmtree(output / STATE_FOLDER, ignore_errors=True)
    return code


def _where_now(output: Path, held: Held, failure: PliantError | None, progress: Progress) -> Path:
    """The present path of the result folder, which may have been renamed.

    Raises ResultError, or why the run failed, where it was deleted.
    """
    now = held.path
    if now is None:
        raise failure or ResultError(f"{output} was deleted during the run: the results are lost")
    if now != output:
        progress.say(f"{output} was renamed during the run: the results go to {now}")
    return now


class _Followed:
    """Shows the progress of a run, and releases an earlier result once a frame is on the disk."""

    def __init__(self, output: Path, progress: Progress) -> None:
        self._output, self._progress, self._size = output, progress, -1

    def on_status(self, status: Status) -> None:
        """Take in a status; called from the bus' thread."""
        if status.service == "ingest" and earlier.is_aside(self._output):  # once a frame
            with suppress(OSError, PliantError):  # looked at again when the folder is left
                self._look()
        self._progress.on_status(status)

    def _look(self) -> None:
        recorded = parts.parts_of(self._output / RECORDING_NAME)
        size = sum(path.stat().st_size for path in recorded)
        if size != self._size and has_frames(self._output):
            let_go(self._output)
        self._size = size


def _go_through(
    request: RunRequest,
    config: Config,
    output: Path,
    fleet: Fleet,
    progress: Progress,
    viewer: Viewer | None,
) -> tuple[bool, PliantError | None]:
    """Start the services and wait for their end: whether it was Ctrl-C, and what went wrong."""
    try:
        if fleet.note:
            progress.say(fleet.note)
        warm_up.compile_kernels(progress.say)  # whatever ends it, an earlier result is as it was
        if not request.resume:
            prepare(output, config_yaml(config))
            if request.on_crash == "restart" and request.known is not None:
                make_folder(output / STATE_FOLDER)
                map_file = MapFile(request.known).path.resolve()
                write_whole(output / STATE_FOLDER / KNOWN_MAP, str(map_file))
        try:
            with announced(output, fleet.endpoint, fleet.session):
                if viewer is not None:
                    viewer.start(fleet)
                with _printed_poses(request, fleet):
                    fleet.start(lambda name: service_arguments(name, request, output))
                    look_on = f"; watch live: pliant view {output}" if has_viewer() else ""
                    with progress:
                        interrupted = _wait(fleet, progress, f"services are up{look_on}")
                if viewer is not None:
                    viewer.see_the_end(fleet)
                return interrupted, None
        except KeyboardInterrupt:
            return True, None
        except PliantError as error:
            return False, error
    finally:
        fleet.close()


def _printed_poses(request: RunRequest, fleet: Fleet) -> AbstractContextManager[None]:
    if not request.poses:
        return nullcontext()
    from pliant_services.run.poses import printed_poses  # loads modules that other runs do not need

    known = None if request.known is None else MapFile(request.known)
    return printed_poses(fleet, known, deformable=request.profile == _DEFORMABLE)


def _wait(fleet: Fleet, progress: Progress, up: str) -> bool:
    """Report that the services are up, and wait for the end of the run; True if it was caused
    by Ctrl-C, which may follow the message at once."""
    try:
        progress.say(up)
        fleet.wait(progress.on_rest)
    except KeyboardInterrupt:
        progress.say("stopping after the current frame (Ctrl-C again to kill)")
        fleet.end_source()
        fleet.wait(progress.on_rest)
        return True
    return False


def service_arguments(name: str, request: RunRequest, output: Path) -> list[str]:
    """Command-line arguments of a service, besides those for the connection."""
    extra = ["--config", str(output / CONFIG_NAME)]
    if name == "ingest":
        extra += ["--source", request.source.to_json()]
        extra += ["--map", str(request.known)] if request.known is not None else []
    if name == "recorder":
        extra += ["--output", str(output / RECORDING_NAME)]
        extra += ["--metadata", str(output / "logs" / "metadata.json")]
    return extra


def _finish(
    output: Path, *, interrupted: bool, failure: PliantError | None, resumed: bool = False
) -> int:
    """Write the results of the recording as far as it goes, and print their place; then raise the
    failure.

    A run without a frame leaves nothing, but for what a service that crashed has left.
    """
    try:
        nothing = not has_frames(output)
    except PliantError as error:
        raise failure or error from None
    if nothing:
        crashed = isinstance(failure, ServiceDiedError) and failure.crashed
        if not (crashed or resumed):
            discard(output, [f"{name}.log" for name in BY_NAME])
        silent = (
            KeyboardInterrupt()
            if interrupted
            else ResultError(f"{output}: the source delivered no frame")
        )
        raise failure or silent
    # They load what a launcher that waits has no use for.
    from pliant.results.verdict import grade
    from pliant.results.write import write_results

    again = f"use pliant run ... --output {output} --resume"
    try:
        report = write_results(output)
    except KeyboardInterrupt:
        print(f"the results are not written; {again} to write them", file=sys.stderr, flush=True)
        raise
    except PliantError as error:
        if failure is not None:  # it came first, and is the cause of this one
            raise failure from None
        if isinstance(error, ResultError):
            raise ResultError(f"{error}: {again}") from None
        raise
    print_summary(output, report)
    if failure is not None:
        raise failure
    return INTERRUPTED if interrupted else grade(report)


def _report_guess(calibration: Calibration, profile: str, progress: Progress) -> None:
    """Report the initial calibration of an unknown camera.  Raises CalibrationError."""
    if calibration.focal_sigma == 0.0:
        return
    if profile == _DEFORMABLE:
        raise CalibrationError(
            "no calibration: --profile deformable needs one: pass --calibration FILE "
            f"({UNDERSTOOD}), or --fov DEGREES"
        )
    fov = math.degrees(2.0 * math.atan(0.5 * calibration.width / calibration.fx))
    progress.say(
        f"no calibration: assuming a {fov:.0f} degree horizontal field of view; the "
        "focal length will be estimated (or pass --calibration FILE, --fov DEGREES)"
    )


def _report_rendering(what: str, done: int, total: int) -> None:
    if done == 0:
        print(f"built-in sequence, {what} (once) ...", file=sys.stderr)
