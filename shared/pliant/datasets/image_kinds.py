"""Folders that hold more than the images of one camera: which of them are meant.

    frame-000001.color.png, frame-000001.depth.png    colour images and depth maps
    0001.jpg, 0001.png                                likewise, by their pixels
    left_0001.png, right_0001.png; cam0_..., cam1_... one camera of several

Files are of one kind where their names differ in numbers alone.
"""

import re
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from pliant.algorithms.image.decoding import decoded
from pliant.datasets.base import VIDEO_SUFFIXES
from pliant.datasets.images import image_files
from pliant.errors import DatasetError
from pliant.wording import counted, shortened

_NUMBER = re.compile(r"[0-9]+")
_CAMERA = re.compile(r"(?i)((?:cam|camera|lens|stream|sensor|view)[-_ ]?)([0-9])(?![0-9])")
_WORDS = re.compile(r"[a-z]+")
_NO_IMAGES = {
    *("depth", "disp", "disparity", "mask", "masks", "seg", "segmentation", "semantic", "label"),
    *("labels", "normal", "normals", "conf", "confidence", "flow", "thumb", "thumbnail", "preview"),
}
_SECOND = {"right", "ir", "infra", "infrared", "thermal", "fisheye"}
_CAMERAS = {"cam", "camera", "image", "images", "left", "grey", "gray", "undistorted"}
_SAME_FRAMES = 0.9
_SUBFOLDERS = (
    *("images", "image", "rgb", "color", "colour", "img", "imgs", "frames", "data"),
    *("left", "cam0", "image_00"),
)
_MAY_HAVE_PAGES = (".tif", ".tiff", ".webp")
_FOREIGN = {
    *(".heic", ".heif", ".avif", ".gif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2"),
    *(".raf", ".raw", ".exr", ".jxl", ".tga", ".svg", ".npy"),
}


def folder_of_images(folder: Path) -> Path | None:
    """The folder itself where it holds images, else the one in it with a usual name that does."""
    if not folder.is_dir():
        return None
    if image_files(folder):
        return folder
    inner = [folder / name for name in _SUBFOLDERS]
    found = next((each for each in inner if each.is_dir() and image_files(each)), None)
    return None if found is None or _is_collection(folder) else found


def _is_collection(folder: Path) -> bool:
    """Whether it also holds clips, or folders of images that have nothing to do with each other."""
    for path in folder.iterdir():
        if path.suffix.lower() in (*VIDEO_SUFFIXES, ".bag", ".mcap"):
            return True
        known = path.name in _SUBFOLDERS or _words(path.name) & (_NO_IMAGES | _SECOND | _CAMERAS)
        if not known and path.name[0] != "." and path.is_dir() and image_files(path):
            return True
    return False


def images_of_one_kind(folder: Path) -> tuple[list[Path], list[str]]:
    """The images of a folder that belong together, in natural order, and what was left out.

    Raises DatasetError.
    """
    files = image_files(folder)
    notes = [*foreign_files(folder), *_pages(files)]
    kinds: dict[str, list[Path]] = defaultdict(list)
    for path in files:
        kinds[_kind(path)].append(path)
    if len(kinds) == 1:
        return files, notes
    chosen = _choose(kinds)
    left_out = {kind: paths for kind, paths in kinds.items() if kind not in chosen}
    if left_out:
        skipped = ", ".join(f"{len(paths)} {shortened(kind)}" for kind, paths in left_out.items())
        used = ", ".join(shortened(kind) for kind in chosen)
        notes.append(f"{folder.name}: using the images {used}; skipping {skipped}")
    return [path for path in files if _kind(path) in chosen], notes


def _kind(path: Path) -> str:
    """The name with # for its numbers, but for that of a camera."""
    name = _CAMERA.sub(lambda found: found[1] + "abcdefghij"[int(found[2])] + "\0", path.name)
    kind = _NUMBER.sub("#", name)
    return re.sub(r"([a-j])\0", lambda found: str("abcdefghij".index(found[1])), kind)


def _choose(kinds: dict[str, list[Path]]) -> list[str]:
    """The kinds that are used: those without a word for something else, one of those that show the
    same frames."""
    plain = [kind for kind in kinds if not _words(kind) & _NO_IMAGES]
    kept: list[str] = []
    for kind in sorted(plain or kinds, key=lambda kind: _preference(kind, kinds[kind])):
        if not any(_show_the_same(kinds[kind], kinds[other]) for other in kept):
            kept.append(kind)
    return [kind for kind in kinds if kind in kept]


def _preference(kind: str, paths: Sequence[Path]) -> tuple[bool, bool, int, str]:
    shape, deep = _pixels(paths[len(paths) // 2])
    is_depth = deep and len(shape) == 2
    return bool(_words(kind) & _SECOND), is_depth, -int(np.prod(shape[:2])), kind


def _words(kind: str) -> set[str]:
    return set(_WORDS.findall(kind.lower()))


def _show_the_same(first: Sequence[Path], second: Sequence[Path]) -> bool:
    """Whether most of the frames of the smaller kind are in the other, by their numbers."""
    ours, theirs = ({tuple(_numbers(path)) for path in paths} for paths in (first, second))
    return len(ours & theirs) >= _SAME_FRAMES * min(len(ours), len(theirs)) > 1


def _numbers(path: Path) -> list[int]:
    return [int(text) for text in _NUMBER.findall(_CAMERA.sub("", path.stem))]


def _pixels(path: Path) -> tuple[tuple[int, ...], bool]:
    """The shape of an image, and whether it has more than 8 bits; (0, 0) of what is none."""
    try:
        pixels = decoded(path.read_bytes(), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from None
    return ((0, 0), False) if pixels is None else (pixels.shape, pixels.dtype != np.uint8)


def _pages(files: Sequence[Path]) -> list[str]:
    """A note where the images are animations or have pages, of which the first is read."""
    able = next((path for path in files if path.suffix.lower() in _MAY_HAVE_PAGES), None)
    try:
        count = 1 if able is None else cv2.imcount(str(able))
    except cv2.error:
        count = 1
    if able is None or count <= 1:
        return []
    return [f"{able.name}: has {count} pages or frames, and only the first is read: convert it"]


def foreign_files(folder: Path) -> list[str]:
    """A note on image files of formats that are not read."""
    try:
        suffixes = [path.suffix.lower() for path in folder.iterdir() if path.name[0] != "."]
    except OSError:
        return []
    found = sorted({suffix for suffix in suffixes if suffix in _FOREIGN})
    if not found:
        return []
    count = sum(suffix in _FOREIGN for suffix in suffixes)
    return [
        f"{folder.name}: {counted(count, 'file')} ({', '.join(found)}) passed over: "
        "unsupported format; convert to JPEG or PNG"
    ]
