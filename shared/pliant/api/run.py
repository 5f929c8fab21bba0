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
from pliant.programs import PYTHON
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
    """Run the whole pipeline on a source, and open its results::

        result = pliant.run("clip.mp4", fov=70)

    The arguments are the options of ``pliant run``; ``pliant run --help`` describes each in full.

    output: result folder [results/<source>]; force: replace an existing result.
    calibration: file of the camera; fov: its horizontal field of view, degrees.
    mask: image whose black parts are ignored in all frames, or a folder with one for each frame.
    auto_mask: also ignore the parts of the image that never change.
    start, end: seconds after the first frame.    every: use one of this many frames; sharpest: the
    sharpest of them instead of the first.    max_size: longer side of the images, px.
    light: a fifth of the tracks.    quality: "high" reads the source a second time where the camera
    was lost.    topic: of the images in a bag or recording.
    imu, gps: file or topic of inertial samples, of satellite fixes.
    map: result or map file to continue; localise: only localise the frames in it.
    camera, depth, depth_frames: of the deformable profile.
    settings: ``{"tracking.max_tracks": 5000}`` or ``["tracking.max_tracks=5000"]``.
    quiet: print nothing.

    on_frame: called in this thread with the number of each frame and its online pose
    T_world_camera (4, 4), or None without a pose.  The run does not wait for these calls, but it
    ends after the last of them.  ``pliant.follow`` also provides the image and tracks of a frame.

    ``result.report["verdict"]`` rates the result.  Raises ResultError with the command's error
    message.  An exception in ``on_frame`` stops the run and is raised again.
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
    command = [*PYTHON, "-m", "pliant_services.cli", "run"]
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
