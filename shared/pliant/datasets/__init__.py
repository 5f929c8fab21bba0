"""Where frames come from: one file per format of dataset, and the built-in sequences.

``open_source`` opens any of them; ``FORMATS`` is the list.  A source gives frames as they came and
the calibration of its camera; ``Rectifier`` turns a frame into the image that all services process.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

from pliant.datasets.base import (
    VIDEO_SUFFIXES,
    BrokenFrame,
    Dataset,
    SourceFrame,
    is_builtin,
)
from pliant.datasets.calibration import Calibration, calibration_from_yaml, calibration_yaml
from pliant.datasets.calibration_files import read_calibration
from pliant.datasets.camera_device import CameraDevice, camera_index
from pliant.datasets.euroc import euroc_sensors, is_euroc, open_euroc
from pliant.datasets.excerpt import Excerpt, Frames, is_all
from pliant.datasets.folder import (
    folder_sensors,
    is_bare_folder,
    is_listed_folder,
    open_bare_folder,
    open_listed_folder,
)
from pliant.datasets.image_kinds import foreign_files
from pliant.datasets.images import SUFFIXES
from pliant.datasets.kitti import is_kitti, open_kitti
from pliant.datasets.masks import Masked
from pliant.datasets.mcap_file import is_mcap, mcap_sensors, open_mcap
from pliant.datasets.measured.base import NOTHING, Measurements
from pliant.datasets.measured.readers import video_sensors
from pliant.datasets.own_recording import (
    is_own_recording,
    open_own_recording,
    recorded_sensors,
)
from pliant.datasets.rectifier import Rectifier, decode
from pliant.datasets.ros_bag import bag_sensors, is_ros_bag, open_ros_bag
from pliant.datasets.source_spec import SourceSpec
from pliant.datasets.static_mask import StaticallyMasked
from pliant.datasets.tum_rgbd import is_tum_rgbd, open_tum_rgbd
from pliant.datasets.video import VideoFile
from pliant.datasets.working_size import SmallerImages, at_working_size
from pliant.errors import DatasetError
from pliant.wording import shortened, shown

__all__ = [
    "FORMATS",
    "BrokenFrame",
    "Calibration",
    "CameraDevice",
    "Dataset",
    "Frames",
    "Rectifier",
    "SourceFormat",
    "SourceFrame",
    "SourceSpec",
    "VideoFile",
    "calibration_from_yaml",
    "calibration_yaml",
    "check_start",
    "decode",
    "formats",
    "notes_on",
    "open_source",
    "read_calibration",
    "sources_in",
]


def _no_sensors(_spec: SourceSpec) -> Measurements:
    return NOTHING


@dataclass(frozen=True)
class SourceFormat:
    """One kind of source.

    recognises: whether a source is of this kind.
    open: opens it; raises DatasetError and CalibrationError.
    sized: its images have their working size already.
    sensors: what its other sensors measured, on the clock of its images; raises PliantError.
    """

    recognises: Callable[[str], bool]
    open: Callable[[SourceSpec], Dataset]
    has_topics: bool = False
    has_depth: bool = False
    sized: bool = False
    sensors: Callable[[SourceSpec], Measurements] = _no_sensors


def _open_builtin(spec: SourceSpec) -> Dataset:
    from pliant.datasets.builtin import builtin_folder

    return open_listed_folder(spec.at(builtin_folder(spec.location)), name=spec.location)


def _is_camera(source: str) -> bool:
    return camera_index(source) is not None and not Path(source).exists()


def _open_camera(spec: SourceSpec) -> Dataset:
    return CameraDevice(camera_index(spec.location) or 0, spec)


def _is_ros(source: str) -> bool:
    return source.startswith("ros:") and not Path(source).exists()


def _open_ros(spec: SourceSpec) -> Dataset:
    from pliant.datasets.ros_camera import open_ros  # Zenoh, which other sources do without

    return open_ros(spec)


def _builtin_sensors(spec: SourceSpec) -> Measurements:
    from pliant.datasets.builtin import builtin_folder

    return folder_sensors(spec.at(builtin_folder(spec.location)))


def _open_video(spec: SourceSpec) -> Dataset:
    path = Path(spec.location)
    if path.suffix.lower() in (*SUFFIXES, ".txt", ".csv", ".yaml"):
        raise DatasetError(f"{path}: a single file of this kind is not a source; pass its folder")
    return VideoFile(path, spec)


FORMATS: dict[str, SourceFormat] = {
    "built-in": SourceFormat(is_builtin, _open_builtin, has_depth=True, sensors=_builtin_sensors),
    "camera": SourceFormat(_is_camera, _open_camera),
    "ros": SourceFormat(_is_ros, _open_ros, has_topics=True),
    "recording": SourceFormat(
        *(is_own_recording, open_own_recording),
        has_depth=True,
        sized=True,
        sensors=recorded_sensors,
    ),
    "mcap": SourceFormat(is_mcap, open_mcap, has_topics=True, sensors=mcap_sensors),
    "ros-bag": SourceFormat(is_ros_bag, open_ros_bag, has_topics=True, sensors=bag_sensors),
    "video": SourceFormat(
        lambda source: Path(source).is_file(), _open_video, sensors=video_sensors
    ),
    "euroc": SourceFormat(is_euroc, open_euroc, sensors=euroc_sensors),
    "kitti": SourceFormat(is_kitti, open_kitti),
    "tum-rgbd": SourceFormat(is_tum_rgbd, open_tum_rgbd, has_depth=True),
    "folder": SourceFormat(
        is_listed_folder, open_listed_folder, has_depth=True, sensors=folder_sensors
    ),
    "images": SourceFormat(is_bare_folder, open_bare_folder),
}
"""Every kind of source that is ours."""

ENTRY_POINTS = "pliant.sources"
"""Under which an installed package names formats of its own: each a ``SourceFormat``."""


@cache
def formats() -> dict[str, SourceFormat]:
    """Every kind of source; the first that recognises a source opens it.

    Those of other packages come first, by name.  Raises DatasetError for one that is none.
    """
    found: dict[str, SourceFormat] = {}
    for point in sorted(entry_points(group=ENTRY_POINTS), key=lambda point: point.name):
        try:
            kind: object = point.load()
        except Exception as error:  # of foreign code
            reason = shortened(f"{type(error).__name__}: {error}".split("\n")[0], 200)
            raise DatasetError(
                f"the source format {point.name} ({point.value}) does not load: {reason}; fix or "
                "uninstall its package"
            ) from error
        if not isinstance(kind, SourceFormat):
            raise DatasetError(
                f"the source format {point.name} ({point.value}) is {shown(kind)}: expected a "
                "pliant.datasets.SourceFormat"
            )
        found[point.name] = kind
    return {**found, **FORMATS}


def open_source(spec: SourceSpec | str, frames: Frames | None = None) -> Dataset:
    """Open a source of frames of any of the ``FORMATS``, and check it as far as can be seen.

    spec: its description, or its location alone.
    frames: which of its frames are used, and how; None: all, at their working size.

    Raises DatasetError or CalibrationError: one line with what is wrong, where, and what to do.
    """
    spec = SourceSpec(location=spec) if isinstance(spec, str) else spec
    source = spec.location
    if not source or "\0" in source:
        raise DatasetError(f"source {shown(source)}: is empty; {HELP}")
    first_depth = spec.depth == "first"
    if first_depth and not is_all(frames):  # the depth of the first frame that is used
        spec = spec.model_copy(update={"depth": "all"})
    path = Path(source)
    try:
        for kind in formats().values():
            if kind.recognises(source):
                if spec.topic and not kind.has_topics:
                    raise DatasetError(f"{source}: has no topics: leave out --topic")
                if spec.depth != "none" and not kind.has_depth:
                    raise DatasetError(
                        f"{source}: has no depth: use a folder with rgb.txt and depth.txt"
                    )
                opened = kind.open(spec)
                opened = opened if spec.mask is None else Masked(opened, spec.mask)
                if frames is not None and not is_all(frames):
                    opened = Excerpt(opened, frames, first_depth_only=first_depth)
                if frames is not None and frames.mask_static and spec.mask is None:
                    opened = StaticallyMasked(opened)
                longest_side_px = 0 if frames is None else frames.longest_side_px
                if kind.sized and not longest_side_px:
                    return opened
                return at_working_size(opened, longest_side_px)
        if not path.exists():
            raise DatasetError(f"{source}: no such file or folder; {HELP}")
    except OSError as error:  # a name too long, a folder that may not be entered, a broken disk
        raise DatasetError(f"{source}: cannot be read: {error.strerror or error}") from None
    if not path.is_dir():
        raise DatasetError(f"{source}: neither a file nor a folder; {HELP}")
    raise DatasetError(f"{source}: {_why_none(path)}")


def _why_none(folder: Path) -> str:
    """Why a folder is no source, and what may be."""
    clips = [each for each in sorted(folder.iterdir()) if each.name[0] != "." and _is_clip(each)]
    if len(clips) == 1:
        return f"is not a source, but contains one: use `pliant run {clips[0]}`"
    if clips:
        return (
            "is not a source, but contains several: pass one of them, or use `pliant batch "
            f"{folder}` for all"
        )
    foreign = foreign_files(folder)
    if foreign:
        return foreign[0].removeprefix(f"{folder.name}: ").replace(" passed over", "")
    what = "contains no source" if any(folder.iterdir()) else "is an empty folder"
    return f"{what}; {HELP}"


def notes_on(dataset: Dataset) -> list[str]:
    """How a source is read and what is done to its images, in lines for people."""
    if isinstance(dataset, Excerpt | StaticallyMasked):
        return notes_on(dataset.source)
    if isinstance(dataset, Masked | SmallerImages):
        return [*notes_on(dataset.source), dataset.note]
    return list(getattr(dataset, "notes", ()))


def check_start(dataset: Dataset) -> None:
    """Raise DatasetError if a source that is opened in part ends before the part begins."""
    whole = dataset
    while isinstance(whole, SmallerImages | StaticallyMasked):
        whole = whole.source
    if isinstance(whole, Excerpt) and not whole.is_live:
        whole.check_start()


HELP = "see `pliant run --help` and docs/sources.md for supported sources"
"""Where the sources are listed that are understood."""


def sources_in(folder: Path, *, but: Path) -> list[Path]:
    """The sources that lie directly in a folder, by name.  but: one that is none, as results are.

    Raises DatasetError if there are none, or the folder is one itself.
    """
    if any(kind.recognises(str(folder)) for kind in formats().values()):
        raise DatasetError(f"{folder}: is itself a sequence: use `pliant run {folder}`")
    try:
        paths = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise DatasetError(f"{folder}: cannot be read: {error.strerror}") from None
    results = (but.resolve(), *but.resolve().parents)
    found = [path for path in paths if path.resolve() not in results and _is_clip(path)]
    if not found:
        raise DatasetError(f"{folder}: contains no source; {HELP}")
    return found


def _is_clip(path: Path) -> bool:
    names = [name for name, kind in formats().items() if kind.recognises(str(path))]
    return bool(names) and (names[0] != "video" or path.suffix.lower() in VIDEO_SUFFIXES)
