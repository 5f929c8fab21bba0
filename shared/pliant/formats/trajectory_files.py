"""Read a trajectory in whichever of the known formats a file has."""

from pathlib import Path

from pliant.errors import ResultError
from pliant.formats.euroc import read_euroc
from pliant.formats.kitti import read_kitti, read_kitti_times
from pliant.formats.text import numbered_lines
from pliant.formats.tum import read_tum
from pliant.trajectory import Trajectory

_EUROC = (
    "mav0/state_groundtruth_estimate0/data.csv",
    "state_groundtruth_estimate0/data.csv",
    "mav0/mocap0/data.csv",
)


def read_trajectory(
    path: Path, *, times: Path | None = None, allow_empty: bool = False
) -> Trajectory:
    """Read TUM, EuRoC or KITTI poses, told apart by their first line.

    path: the file, or a folder that holds ``groundtruth.txt`` or the ground truth of EuRoC.
    times: ``times.txt`` of a KITTI sequence; without it KITTI poses have no time, which is an
        error.  Raises ResultError with file and line.
    """
    if path.is_dir():
        names = ("groundtruth.txt", *_EUROC)
        path = next((path / name for name in names if (path / name).is_file()), path / names[0])
    first = next((line for _, line in numbered_lines(path)), None)
    if first is None:
        if allow_empty:
            return Trajectory.empty()
        raise ResultError(f"{path}: holds no poses")
    if "," in first:
        return read_euroc(path)
    if len(first.split()) == 12:
        times = times if times is not None else path.with_name("times.txt")
        if not times.is_file():
            raise ResultError(
                f"{path}: KITTI poses have no times, and {times} does not exist: pass the "
                "times file"
            )
        return read_kitti(path, read_kitti_times(times))
    return read_tum(path)
