"""The built-in sequences: rendered on first use into a cache, then folders like any other.

A source is ``built-in:NAME`` or ``built-in:NAME?option=value&option=value``.  A folder holds

    images/NNNNNN.png   grey (or RGB), 8 bit
    rgb.txt             time in seconds (the middle of the exposure) and file, one frame a line
    calib.yaml          the camera, with ``depth_scale`` and the pinhole camera of the depth
    groundtruth.txt     TUM: time, position, quaternion xyzw of T_world_camera, exact
    depth/NNNNNN.png    16 bit, z in steps of ``depth_scale`` metres at the pixel centres of the
                        rectified image, 0: nothing there;  depth.txt lists them like rgb.txt
    surface.ply         points of the surface that the camera saw, with normals, on a 1 cm grid
    scene.json          the scene, the camera and the renderer's version: what the folder is made of

Images are written as they leave the lens: with distortion, they must be rectified to fit the depth.
"""

import contextlib
import fcntl
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from pydantic import Field, ValidationError

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import matrix_to_pose
from pliant.algorithms.parameters import Parameters
from pliant.cache import cache_folder
from pliant.errors import DatasetError, ResultError
from pliant.rendering.atlas import FaceTexture, make_face
from pliant.rendering.lens import NO_DISTORTION, Distortion, pixel_rays
from pliant.rendering.paths import CameraPath, SampledPath
from pliant.rendering.render import CameraOptions, RenderedFrame, Renderer, SceneGeometry
from pliant.rendering.scenes import SCENES, BuiltinScene

PREFIX = "built-in:"
# Raise it with every change that alters a single pixel: old caches are then passed over.
RENDERER_VERSION = 2

Progress = Callable[[str, int, int], None]
"""Called with what is being done, steps done, and steps in all."""

_LOOK_STRIDE = 8  # pixels
_UNSEEN_DETAIL = 0.1
_SURFACE_EVERY = 10  # frames
_SURFACE_STRIDE = 4  # pixels
_SURFACE_GRID_M = 0.01


class SequenceOptions(Parameters):
    """What may be said after the name of a built-in sequence."""

    frames: int | None = Field(
        default=None, ge=2, description="First frames only; all where not given."
    )
    width: int | None = Field(
        default=None, ge=64, le=2048, description="Columns; 3/4 as many rows."
    )
    noise: float = Field(default=2.0, ge=0.0, le=50.0, description="Image noise, grey values.")
    exposure: float = Field(
        default=0.2, ge=0.0, lt=1.0, description="Swing of the exposure; 0.2: 20 %."
    )
    blur: float = Field(
        default=0.3, ge=0.0, le=1.0, description="Open shutter, share of the frame time."
    )
    distortion: Distortion = Field(default=NO_DISTORTION, description="k1,k2,p1,p2 of the lens.")
    colour: bool = Field(default=False, description="Colour images.")
    seed: int = Field(default=0, ge=0, description="Seed of the noise.")
    path: str | None = Field(
        default=None, description="TUM file with the camera path, at its own times."
    )


@dataclass(frozen=True)
class _Plan:
    """Everything that a sequence is made of."""

    name: str
    builtin: BuiltinScene
    camera: CameraOptions
    path: CameraPath
    stamps_ns: list[int]
    start_ns: int  # stamp at which the path begins

    def description(self) -> dict[str, Any]:
        """What determines every byte of the folder, as JSON."""
        times = [(stamp - self.start_ns) * 1e-9 for stamp in self.stamps_ns]
        poses = np.array([self.path.T_world_camera(time) for time in times])
        return {
            "renderer_version": RENDERER_VERSION,
            "sequence": self.name,
            "frames": len(self.stamps_ns),
            "first_stamp_ns": self.stamps_ns[0],
            "path_sha256": hashlib.sha256(np.round(poses, 9).tobytes()).hexdigest(),
            "camera": self.camera.model_dump(mode="json"),
            "scene": self.builtin.scene.model_dump(mode="json"),
        }


def is_builtin(source: str) -> bool:
    """Whether a source names a built-in sequence."""
    return source.startswith(PREFIX)


def parse_builtin(source: str) -> tuple[str, SequenceOptions]:
    """Split ``built-in:NAME?option=value&...`` (the prefix may be missing) and check all of it.

    Raises DatasetError that lists the valid names or options.
    """
    name, _, query = source.removeprefix(PREFIX).partition("?")
    _check_name(name)
    given: dict[str, Any] = {}
    for item in filter(None, query.split("&")):
        key, equals, value = item.partition("=")
        if key not in SequenceOptions.model_fields:
            valid = ", ".join(SequenceOptions.model_fields)
            raise DatasetError(f"{source}: unknown option {key!r}; valid options: {valid}")
        if not equals:
            raise DatasetError(f"{source}: option {key!r} has no value; write {key}=VALUE")
        given[key] = tuple(value.split(",")) if key == "distortion" else value
    try:
        return name, SequenceOptions.model_validate(given)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"][:1])
        raise DatasetError(
            f"{source}: option {where}={first['input']}: {first['msg'].lower()}"
        ) from None


def builtin_folder(
    source: str,
    options: SequenceOptions | None = None,
    *,
    cache: Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """The folder of a built-in sequence, rendered now if the cache does not hold it.

    source: ``built-in:NAME?...`` or a bare name; ``options`` replace those in the source.
    A rendering that is interrupted leaves nothing behind that could be taken for a sequence, and
    two processes that want the same sequence render it once.
    """
    name, parsed = parse_builtin(source)
    plan = _plan(name, options or parsed)
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


def render_sequence(
    name: str,
    output: Path,
    options: SequenceOptions | None = None,
    *,
    progress: Progress | None = None,
) -> Path:
    """Render a sequence into a new folder ``output``.  DatasetError if that exists already."""
    if output.exists():
        raise DatasetError(f"{output}: exists already; name another folder or remove it first")
    _check_name(name)
    plan = _plan(name, options or SequenceOptions())
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        _render_beside(plan, output, progress)
    except OSError as error:
        raise DatasetError(f"{output}: cannot write ({error.strerror or error})") from error
    return output


def _check_name(name: str) -> None:
    if name not in SCENES:
        valid = ", ".join(PREFIX + known for known in SCENES)
        raise DatasetError(f"{PREFIX}{name}: no such built-in sequence; valid: {valid}")


def _plan(name: str, options: SequenceOptions) -> _Plan:
    builtin = SCENES[name]()
    width = options.width or builtin.width
    camera = CameraOptions(
        width=width,
        height=3 * width // 4,
        noise=options.noise,
        exposure=options.exposure,
        blur=options.blur,
        distortion=options.distortion,
        colour=options.colour,
        seed=options.seed,
    )
    try:
        pixel_rays(camera.pinhole(), camera.distortion)
    except ValueError as error:
        raise DatasetError(f"{PREFIX}{name}: {error}; choose smaller coefficients") from None
    if options.path is None:
        path: CameraPath = builtin.path
        stamps = [i * 1_000_000_000 // 30 for i in range(builtin.frames)]
    else:
        path, stamps = _given_path(Path(options.path))
    if options.frames is not None and options.frames > len(stamps):
        raise DatasetError(
            f"{PREFIX}{name}: frames={options.frames}: the path has only {len(stamps)} frames"
        )
    return _Plan(name, builtin, camera, path, stamps[: options.frames], stamps[0])


def _given_path(file: Path) -> tuple[CameraPath, list[int]]:
    from pliant.export.tum import read_tum

    try:
        trajectory = read_tum(file)
    except ResultError as error:
        raise DatasetError(str(error)) from None
    stamps = [int(stamp) for stamp in trajectory.stamps_ns]
    if len(stamps) < 2:
        raise DatasetError(f"{file}: a camera path needs at least 2 poses, got {len(stamps)}")
    times = np.array([(stamp - stamps[0]) * 1e-9 for stamp in stamps], np.float64)
    return SampledPath(times, np.asarray(trajectory.poses, np.float64)), stamps


@contextlib.contextmanager
def _locked(path: Path) -> Generator[None]:
    """Hold an exclusive lock; the system frees it even when the process is killed."""
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _render_beside(plan: _Plan, folder: Path, progress: Progress | None) -> None:
    """Render into a temporary folder next to ``folder``, then rename it: all or nothing."""
    # Whoever holds the lock may clear away what a killed process left behind.
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
    geometry = SceneGeometry(plan.builtin.scene)
    # Kernels release the interpreter, and so does the PNG encoder: threads are enough.
    executor = ThreadPoolExecutor(max_workers=min(os.cpu_count() or 1, 8))
    try:
        seen = _seen_faces(plan, geometry)

        def paint(number: int) -> FaceTexture:
            detail = 1.0 if number in seen else _UNSEEN_DETAIL
            return make_face(geometry.scene, geometry.solids, number, detail=detail)

        textures: list[FaceTexture] = []
        for texture in executor.map(paint, range(geometry.n_faces)):
            textures.append(texture)
            progress("painting textures", len(textures), geometry.n_faces)
        renderer = Renderer(geometry, textures, plan.path, plan.camera)
        (folder / "images").mkdir()
        (folder / "depth").mkdir()

        def film(number: int) -> F64:
            time_s = (plan.stamps_ns[number] - plan.start_ns) * 1e-9
            frame = renderer.frame(number, time_s)
            _write_frame(folder, number, frame, plan.builtin.scene.depth_scale)
            return matrix_to_pose(frame.T_world_camera)

        poses: list[F64] = []
        for pose in executor.map(film, range(len(plan.stamps_ns))):
            poses.append(pose)
            progress("rendering frames", len(poses), len(plan.stamps_ns))
    finally:
        executor.shutdown(wait=True, cancel_futures=True)
    _write_lists(folder, plan, poses)
    _write_calibration(folder, plan)
    _write_surface(folder, plan, geometry)
    text = json.dumps(plan.description(), sort_keys=True, indent=1)
    (folder / "scene.json").write_text(text + "\n")


def _seen_faces(plan: _Plan, geometry: SceneGeometry) -> frozenset[int]:
    """Faces that a coarse look along the path sees.  The others need no fine texture."""
    rays = pixel_rays(plan.camera.pinhole(), plan.camera.distortion)
    rays = np.ascontiguousarray(rays[::_LOOK_STRIDE, ::_LOOK_STRIDE])
    seen: set[int] = set()
    for stamp in plan.stamps_ns:
        T = plan.path.T_world_camera((stamp - plan.start_ns) * 1e-9)
        seen.update(np.unique(geometry.surface(T, rays).faces).tolist())
    return frozenset(seen)


def _write_frame(folder: Path, number: int, frame: RenderedFrame, depth_scale: float) -> None:
    steps = np.rint(frame.depth_m / depth_scale)
    # 0 stands for "nothing there", so what is too far for 16 bits becomes 0 as well.
    depth = np.where(steps <= 65535.0, steps, 0.0).astype(np.uint16)
    image = frame.image if frame.image.ndim == 2 else frame.image[:, :, ::-1]
    for kind, pixels in (("images", image), ("depth", depth)):
        # Level 1: noise hardly compresses, and reading must be quick.
        done, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if not done:
            raise RuntimeError("OpenCV cannot encode PNG")
        (folder / kind / f"{number:06d}.png").write_bytes(data.tobytes())


def _write_lists(folder: Path, plan: _Plan, poses: list[F64]) -> None:
    times = [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in plan.stamps_ns]
    for file, kind in (("rgb.txt", "images"), ("depth.txt", "depth")):
        lines = [f"{time} {kind}/{i:06d}.png" for i, time in enumerate(times)]
        (folder / file).write_text("\n".join(["# timestamp filename", *lines]) + "\n")
    header = "# timestamp tx ty tz qx qy qz qw  (T_world_camera)"
    lines = [
        f"{time} {' '.join(f'{value:.10f}' for value in pose)}"
        for time, pose in zip(times, poses, strict=True)
    ]
    (folder / "groundtruth.txt").write_text("\n".join([header, *lines]) + "\n")


def _write_calibration(folder: Path, plan: _Plan) -> None:
    camera = plan.camera.pinhole()
    k1, k2, p1, p2 = plan.camera.distortion
    content = {
        "camera": f"{PREFIX}{plan.name}",
        "model": "pinhole" if plan.camera.distortion == NO_DISTORTION else "pinhole-radtan",
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "k1": k1,
        "k2": k2,
        "p1": p1,
        "p2": p2,
        "fps": plan.camera.fps,
        "colour": "rgb png" if plan.camera.colour else "grey",
        "depth_scale": plan.builtin.scene.depth_scale,
        "depth_invalid": [0],
        "depth_fx": camera.fx,
        "depth_fy": camera.fy,
        "depth_cx": camera.cx,
        "depth_cy": camera.cy,
    }
    (folder / "calib.yaml").write_text(yaml.safe_dump(content, sort_keys=False))


def _write_surface(folder: Path, plan: _Plan, geometry: SceneGeometry) -> None:
    """Points that some frame sees, one in each cell of a grid, with their exact normals."""
    rays = pixel_rays(plan.camera.pinhole(), NO_DISTORTION)
    rays = np.ascontiguousarray(rays[::_SURFACE_STRIDE, ::_SURFACE_STRIDE])
    seen: list[F64] = []
    for stamp in plan.stamps_ns[::_SURFACE_EVERY]:
        T = plan.path.T_world_camera((stamp - plan.start_ns) * 1e-9)
        surface = geometry.surface(T, rays)
        depth = surface.depth_m[:, :, None]
        points = np.concatenate([rays * depth, depth], axis=2) @ T[:3, :3].T + T[:3, 3]
        rows = np.concatenate([points, surface.normals], axis=2)
        seen.append(rows[surface.faces >= 0])
    rows = np.concatenate(seen)
    cells = np.floor((rows[:, :3] - rows[:, :3].min(axis=0)) / _SURFACE_GRID_M).astype(np.int64)
    sizes = cells.max(axis=0) + 1
    _, first = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(sizes)), return_index=True)
    points = rows[np.sort(first)].astype("<f4")
    names = ("x", "y", "z", "nx", "ny", "nz")
    header = "ply\nformat binary_little_endian 1.0\n" + f"element vertex {len(points)}\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    (folder / "surface.ply").write_bytes(header.encode() + points.tobytes())
