"""The command ``pliant run`` from Python: the same processes, the same result folder."""

import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pliant.api.result import Result
from pliant.config import settings_of
from pliant.errors import ResultError
from pliant.recording import parts
from pliant.results.folder import RECORDING_NAME, folder_name
from pliant.results.verdict import DONE, INCOMPLETE


def run(
    source: str | Path,
    *,
    output: str | Path | None = None,
    force: bool = False,
    calibration: str | Path | None = None,
    fov: float | None = None,
    mask: str | Path | None = None,
    profile: Literal["rigid", "deformable"] = "rigid",
    settings: Mapping[str, Any] | None = None,
    seed: int | None = None,
    quiet: bool = False,
) -> Result:
    """Run the whole pipeline on a source, and open what it leaves::

        result = pliant.run("clip.mp4", fov=70)

    output: result folder [results/<source>]; force: write into an existing one.    mask: an image
    whose black parts are ignored in all frames, or a folder of them.    settings: as
    ``{"tracking.max_tracks": 5000}``.    quiet: print nothing.    ``result.report["verdict"]``
    says whether it went well.    Raises ResultError with what the command says.
    """
    folder = Path("results") / folder_name(str(source)) if output is None else Path(output)
    command = [sys.executable, "-m", "pliant_services.cli", "run", str(source)]
    command += ["--output", str(folder), "--profile", profile]
    command += ["--force"] if force else []
    command += ["--calibration", str(calibration)] if calibration is not None else []
    command += ["--fov", str(fov)] if fov is not None else []
    command += ["--mask", str(mask)] if mask is not None else []
    command += ["--seed", str(seed)] if seed is not None else []
    for setting in settings_of(settings or {}):
        command += ["--set", setting]
    said = ""
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, start_new_session=True,  # Ctrl-C is ours to hand on, once
    ) as process:  # fmt: skip
        assert process.stdout is not None
        try:
            for line in process.stdout:
                said = line.strip() or said
                if not quiet:
                    print(line, end="", file=sys.stderr)  # a notebook's, too
        except KeyboardInterrupt:
            process.send_signal(signal.SIGINT)
            process.communicate()
            raise
    if process.returncode not in (DONE, INCOMPLETE) or not parts.exists(folder / RECORDING_NAME):
        raise ResultError(said.removeprefix("pliant: "))
    return Result(folder)
