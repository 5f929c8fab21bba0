"""The built-in sequences: rendered on first use into a cache, then folders like any other.

A source is ``built-in:NAME`` or ``built-in:NAME?option=value&option=value``.  A folder holds

    images/NNNNNN.png   grey (or RGB), 8 bit
    rgb.txt             time in seconds (the middle of the exposure) and file, one frame a line
    calib.yaml          the camera, with ``depth_scale`` and the pinhole camera of the depth
    groundtruth.txt     TUM: time, position, quaternion xyzw of T_world_camera, exact
    depth/NNNNNN.png    16 bit, z in steps of ``depth_scale`` metres at the pixel centres of the
                        rectified image, 0: nothing there;  depth.txt lists them like rgb.txt
    surface.ply         rigid scenes: points of the surface that the camera saw, with normals, on a
                        1 cm grid
    surfaces.npz        deforming scenes: the surfaces in every frame, see ``builtin_deforming``
    scene.json          the scene, the camera and the renderer's version: what the folder is made of

Images are written as they leave the lens: with distortion, they must be rectified to fit the depth.
"""

import contextlib
import fcntl
import hashlib
import json
import shutil
import tempfile
from collections.abc import Generator
from pathlib import Path
from typing import Any, Protocol

from pydantic import ValidationError

from pliant.algorithms.parameters import Parameters
from pliant.cache import cache_folder
from pliant.datasets.base import BUILTIN_PREFIX as PREFIX
from pliant.datasets.base import is_builtin
from pliant.datasets.builtin_deforming import deforming_plan
from pliant.datasets.builtin_rigid import SequenceOptions, rigid_plan
from pliant.datasets.sequence_files import Progress
from pliant.errors import DatasetError
from pliant.rendering.deforming_scenes import DEFORMING, DeformingOptions
from pliant.rendering.scenes import SCENES
from pliant.wording import shown

__all__ = [
    "SequenceOptions",
    "builtin_folder",
    "is_deforming",
    "parse_builtin",
]

Options = SequenceOptions | DeformingOptions


class _Plan(Protocol):
    """Everything that a sequence is made of."""

    def description(self) -> dict[str, Any]:
        """The options and versions that determine every byte of the folder, as JSON."""
        ...

    def render(self, folder: Path, progress: Progress) -> None:
        """Fill an empty folder, but for ``scene.json``."""
        ...


def is_deforming(source: str) -> bool:
    """Whether a source names a built-in sequence of a deforming scene."""
    return is_builtin(source) and source.removeprefix(PREFIX).partition("?")[0] in DEFORMING


def parse_builtin(source: str) -> tuple[str, Options]:
    """Split ``built-in:NAME?option=value&...`` (the prefix may be missing) and check all of it.

    Raises DatasetError that lists the valid names or options.
    """
    name, _, query = source.removeprefix(PREFIX).partition("?")
    if name not in SCENES and name not in DEFORMING:
        valid = ", ".join(PREFIX + known for known in (*SCENES, *DEFORMING))
        raise DatasetError(f"{PREFIX}{name}: no such built-in sequence; valid: {valid}")
    kind: type[Parameters] = DEFORMING[name].options if name in DEFORMING else SequenceOptions
    given: dict[str, Any] = {}
    for item in filter(None, query.split("&")):
        key, equals, value = item.partition("=")
        if key not in kind.model_fields:
            valid = ", ".join(kind.model_fields)
            raise DatasetError(f"{source}: unknown option {shown(key)}; valid options: {valid}")
        if not equals:
            raise DatasetError(f"{source}: option {shown(key)} has no value; use {key}=VALUE")
        given[key] = tuple(value.split(",")) if key == "distortion" else value
    try:
        options = kind.model_validate(given)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"][:1])
        raise DatasetError(
            f"{source}: option {where}={first['input']}: {first['msg'].lower()}"
        ) from None
    assert isinstance(options, SequenceOptions | DeformingOptions)
    return name, options


def builtin_folder(
    source: str,
    *,
    cache: Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """The folder of a built-in sequence, rendered now if the cache does not hold it.

    source: ``built-in:NAME?...`` or a bare name.
    A rendering that is interrupted leaves nothing behind that could be taken for a sequence, and
    two processes that want the same sequence render it once.
    """
    name, options = parse_builtin(source)
    plan = _plan(name, options)
    text = json.dumps(plan.description(), sort_keys=True)
    root = (cache or cache_folder()) / "sequences"
    folder = root / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    if folder.is_dir():
        return folder
    try:
        root.mkdir(parents=True, exist_ok=True)
        with _locked(root / f".{folder.name}.lock"):
            if not folder.is_dir():
                _render_beside(plan, folder, progress)
    except OSError as error:
        raise DatasetError(
            f"{folder}: cannot write the rendered sequence ({error.strerror or error}); "
            "free some space or set PLIANT_CACHE_DIR to another folder"
        ) from error
    return folder


def _plan(name: str, options: Options) -> _Plan:
    if name in DEFORMING:
        assert isinstance(options, DeformingOptions)
        return deforming_plan(name, options)
    assert isinstance(options, SequenceOptions)
    return rigid_plan(name, options)


@contextlib.contextmanager
def _locked(path: Path) -> Generator[None]:
    """Hold an exclusive lock; the system frees it even when the process is killed."""
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _render_beside(plan: _Plan, folder: Path, progress: Progress | None) -> None:
    """Render into a temporary folder next to ``folder``, then rename it: all or nothing."""
    # The holder of the lock may remove files of a killed process.
    for leftover in folder.parent.glob(f".{folder.name}.*.partial"):
        shutil.rmtree(leftover, ignore_errors=True)
    partial = Path(
        tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=".partial", dir=folder.parent)
    )
    try:
        _render_into(plan, partial, progress or (lambda _what, _done, _total: None))
        partial.chmod(0o755)
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _render_into(plan: _Plan, folder: Path, progress: Progress) -> None:
    progress("rendering", 0, 1)  # kernels may have to be compiled before the first texture
    plan.render(folder, progress)
    text = json.dumps(plan.description(), sort_keys=True, indent=1)
    (folder / "scene.json").write_text(text + "\n")
