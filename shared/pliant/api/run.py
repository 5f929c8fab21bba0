"""The command ``pliant run`` from Python: the same processes, the same result folder."""

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import pose_to_matrix
from pliant.api.result import Result
from pliant.config import Settings, overrides_of
from pliant.errors import ResultError
from pliant.exit_codes import DONE, INCOMPLETE
from pliant.recording import parts
from pliant.results.folder import RECORDING_NAME, folder_name

OnFrame = Callable[[int, F64 | None], object]
"""Called with the number of a frame and its pose T_world_camera (4, 4), or None without a pose."""


def run(
    source: str | Path,
    *,
    output: str | Path | None = None,
    force: bool = False,
    calibration: str | Path | None = None,
    fov: float | None = None,
    mask: str | Path | None = None,
    auto_mask: bool = True,
    start: float | None = None,
    end: float | None = None,
    every: int | None = None,
    sharpest: bool = False,
    light: bool = False,
    quality: Literal["normal", "high"] = "normal",
    topic: str | None = None,
    imu: str | Path | None = None,
    gps: str | Path | None = None,
    max_size: int | None = None,
    mode: Literal["lossless", "live"] | None = None,
    map: str | Path | None = None,
    localise: bool = False,
    profile: Literal["rigid", "deformable"] = "rigid",
    camera: Literal["static", "moving"] | None = None,
    depth: Literal["sensor", "map", "flat"] | None = None,
    depth_frames: Literal["first", "all"] | None = None,
    images: bool = True,
    settings: Settings = None,
    seed: int | None = None,
    on_frame: OnFrame | None = None,
    quiet: bool = False,
) -> Result:
    """Run the whole pipeline on a source, and open what it leaves::

        result = pliant.run("clip.mp4", fov=70)

    Arguments are the options of ``pliant run``: ``pliant run --help`` says more of each.

    output: result folder [results/<source>]; force: write into an existing one.    mask: an image
    whose black parts are ignored in all frames, or a folder of them; auto_mask: mask
    what never changes.    start, end: seconds after
    the first frame; every: one of this many frames; sharpest: of those, not the first.    light: a
    fifth of the tracks.    quality: "high" reads the source again where the camera was lost.
    imu, gps: a file of inertial samples, of satellite fixes, or their topic.
    max_size: pixels along the longer side.    map: of an earlier run, to go
    on in; localise: only to find the frames in it.    camera, depth, depth_frames: of the
    deformable profile.    settings: ``{"tracking.max_tracks": 5000}`` or
    ``["tracking.max_tracks=5000"]``.    quiet: print nothing.

    on_frame: called in this thread with each frame's number and its pose (4, 4), as it is known
    then (``result.online_trajectory``), or None: ``on_frame(12, T_world_camera)``.  The run does
    not wait for it, but its end does; ``pliant.follow`` gives each frame with its image and tracks.

    ``result.report["verdict"]`` says whether it went well.  Raises ResultError with what the
    command says, and what ``on_frame`` raises, when the run has been stopped for it.
    """
    folder = Path("results") / folder_name(str(source)) if output is None else Path(output)
    options: dict[str, object] = {
        "output": folder, "force": force, "calibration": calibration, "fov": fov, "mask": mask,
        "no-auto-mask": not auto_mask,
        "start": start, "end": end, "every": every, "sharpest": sharpest, "light": light,
        "quality": quality, "topic": topic, "imu": imu, "gps": gps, "max-size": max_size,
        "mode": mode, "map": map, "localise": localise, "profile": profile,
        "camera": camera, "depth": depth, "depth-frames": depth_frames, "no-images": not images,
        "seed": seed, "poses": on_frame is not None,
    }  # fmt: skip
    command = [sys.executable, "-m", "pliant_services.cli", "run"]
    for name, value in options.items():
        if value is not None and value is not False:
            command += [f"--{name}"] if value is True else [f"--{name}", str(value)]
    for setting in overrides_of(settings):
        command += ["--set", setting]
    command += ["--", str(source)]  # its name may begin with a dash
    last_line = ""
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, start_new_session=True,  # Ctrl-C is ours to hand on, once
    ) as process:  # fmt: skip
        assert process.stdout is not None
        try:
            for line in process.stdout:
                if on_frame is not None and line.startswith("pose "):
                    on_frame(*_pose_of(line))
                    continue
                last_line = line.strip() or last_line
                if not quiet:
                    print(line, end="", file=sys.stderr)  # a notebook's, too
        except BaseException:
            process.send_signal(signal.SIGINT)
            process.communicate()
            raise
    if process.returncode not in (DONE, INCOMPLETE) or not parts.exists(folder / RECORDING_NAME):
        raise ResultError(last_line.removeprefix("pliant: "))
    return Result(folder)


def _pose_of(line: str) -> tuple[int, F64 | None]:
    """Parse a line of ``--poses``: the number of a frame, and its pose (4, 4) or None."""
    _, frame, _, *pose = line.split()
    return int(frame), pose_to_matrix(np.array(pose, np.float64)) if pose else None
