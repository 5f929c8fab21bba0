"""The depth and the normals of a run's keyframes, with their images.

    images/000012.png     the keyframe, as ``IdealCamera`` sees it
    masks/000012.png      black where the keyframe's mask ignores pixels; depth is unknown there
    depth/000012.png      16 bits, along the optical axis; 0: unknown
    normals/000012.png    RGB, 127.5 (n + 1) with n in the camera (x right, y down, z forward) and
                          towards it; black: unknown
    rgb.txt, depth.txt    seconds and file of each, as TUM's RGB-D benchmark has them
    groundtruth.txt       T_world_camera of the keyframes, likewise
    calib.yaml            the camera; ``depth_scale`` times a value is a depth

So it is an RGB-D sequence that ``pliant run`` opens, too.  Depths are in the unit of the map, which
is a metre only if the scale was measured.  ``depth_scale`` is the power of ten at which the largest
depth fits: 0.001 for 6.6 to 65.5 units, 0.0001 for less.
"""

from functools import partial
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F32, U8, U16
from pliant.algorithms.image.masks import mask_image
from pliant.algorithms.meshing.keyframe_surface import KeyframeSurfaces, SeenPoints
from pliant.algorithms.meshing.parameters import SurfaceParameters
from pliant.algorithms.meshing.rendering import normals_of
from pliant.datasets.calibration import DepthImages
from pliant.export.images import (
    camera_of,
    image_name,
    make_folder,
    pinhole_yaml,
    rectified_images,
    write_list,
    write_png,
)
from pliant.export.posed_images import IdealCamera
from pliant.formats.text import write_bytes
from pliant.formats.tum import write_tum
from pliant.map_history import MapHistory
from pliant.recording.reader import Recording
from pliant.results.run import read_run, seen_by_keyframes
from pliant.trajectory import Trajectory

_LARGEST = 65535
_FITTING = 0.999
"""Share of the observations whose depth must fit."""


def depth(recording: Recording, path: Path, folder: Path | None) -> None:
    """The folders and lists above, of the longest segment."""
    run = read_run(recording.path)
    ideal = IdealCamera(run)
    seen = _seen(recording, ideal, run.history)
    scale = _scale(ideal, seen)
    surfaces = KeyframeSurfaces(ideal.camera, SurfaceParameters())
    for kind in ("images", "depth", "normals"):
        make_folder(path / kind)
    stamps, with_depth = dict[int, str](), dict[int, str]()
    for frame, stamp_ns, pixels, used in rectified_images(recording, camera_of(recording), seen):
        name = stamps[stamp_ns] = image_name(frame)
        write_png(path / "images" / name, ideal.image(frame, pixels))
        found = surfaces.surface(ideal.poses[frame], seen[frame]).depth_map
        if found is None:
            continue
        if used is not None:
            mask = mask_image(used, partial(ideal.image, frame))
            make_folder(path / "masks")
            write_png(path / "masks" / name, mask)
            found = found.within(mask > 0)
        with_depth[stamp_ns] = name
        write_png(path / "depth" / name, _in_units(found.depths, scale))
        write_png(path / "normals" / name, _coloured(normals_of(found.depths, ideal.camera)))
    write_list(path / "rgb.txt", "images", stamps)
    write_list(path / "depth.txt", "depth", with_depth)
    poses = np.array([ideal.poses[int(name.split(".")[0])] for name in stamps.values()])
    trajectory = Trajectory(stamps_ns=np.array(list(stamps)), T_world_camera=poses)
    write_tum(path / "groundtruth.txt", trajectory)
    images = DepthImages(scale_m=scale, camera=ideal.camera)
    write_bytes(path / "calib.yaml", pinhole_yaml(ideal.camera, images).encode())


def _seen(recording: Recording, ideal: IdealCamera, history: MapHistory) -> dict[int, SeenPoints]:
    """The points that each keyframe observes and their pixels, by its frame."""
    seen_at = seen_by_keyframes(recording, set(ideal.keyframes.values()))
    seen: dict[int, SeenPoints] = {}
    for frame, keyframe in ideal.keyframes.items():
        if keyframe not in seen_at:
            continue
        rows, points = history.points_of(seen_at[keyframe].point_ids)
        seen[frame] = SeenPoints(
            ids=points.ids,
            points_px=ideal.pixels(frame, seen_at[keyframe].points_px[rows]),
            points_world=points.positions,
            sigmas=np.asarray(points.sigmas, np.float32),
            keyframes=np.asarray(points.keyframes, np.int32),
        )
    return seen


def _scale(ideal: IdealCamera, seen: dict[int, SeenPoints]) -> float:
    """Units of the map in one of a 16-bit image."""
    depths = [np.zeros(0)]
    for frame, points in seen.items():
        T = ideal.poses[frame]
        depths.append((points.points_world - T[:3, 3]) @ T[:3, 2])
    deepest = np.quantile(np.maximum(np.concatenate([*depths, np.ones(1)]), 0.0), _FITTING)
    return float(10.0 ** np.ceil(np.log10(max(float(deepest), 1e-6) / _LARGEST)))


def _in_units(depths: F32, scale: float) -> U16:
    """(H, W) whole units; 0 also where they are too many."""
    units = np.rint(depths / np.float32(scale))
    return np.where(units <= _LARGEST, units, 0.0).astype(np.uint16)


def _coloured(normals: F32) -> U8:
    """(H, W, 3) RGB of normals."""
    known = normals.any(axis=-1, keepdims=True)
    return np.where(known, np.rint(127.5 * (normals + 1.0)), 0.0).astype(np.uint8)
