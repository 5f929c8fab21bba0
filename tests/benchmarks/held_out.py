"""The textured mesh of a run beside frames of it that had no part in the texture.

A mesh without a true one to compare with is judged by what it looks like: frames that are no
keyframes are rendered at their final poses.  ZNCC in windows of half the image's size that have
texture, those within the mesh, and all, where a window that meets a hole counts 0; share of the
pixels that the mesh covers; mean difference of colours, beside one factor for each channel.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.arrays import F32, U8, BoolArray
from pliant.algorithms.meshing.rendering import view_mesh
from pliant.errors import ResultError
from pliant.export.images import camera_of, rectified_images
from pliant.export.posed_images import IdealCamera
from pliant.formats.textured import TexturedMesh
from pliant.recording.reader import Recording
from pliant.results.folder import RECORDING_NAME
from pliant.results.mesh_files import mesh_of
from pliant.results.run import read_run
from pliant.results.textured_mesh import textured

_FRAMES, _TRIANGLES, _TEXELS = 20, 40_000, 2048
_WINDOW = 15
"""Pixels of the image at half size."""
_LEAST_VARIANCE = 25.0
"""Of a window with texture, grey levels squared."""
_HEADER = ("run", "frames", "covered", "ZNCC", "holes as 0", "mean difference (of 255)")


class _Score(NamedTuple):
    covered: float
    zncc: float
    with_holes: float
    difference: float


def measure(results: list[Path]) -> Iterator[str]:
    """A row for each result folder: the means over twenty frames."""
    yield markdown_header(_HEADER)
    for result in results:
        scores = list(_scores(result / RECORDING_NAME))
        mean = _Score(*np.mean(scores, axis=0).tolist())
        yield markdown_row(
            (
                *(result.name, str(len(scores)), f"{mean.covered:.1%}", f"{mean.zncc:.3f}"),
                *(f"{mean.with_holes:.3f}", f"{mean.difference:.1f}"),
            )
        )


def _scores(path: Path) -> Iterator[_Score]:
    recording, run = Recording(path), read_run(path)
    ideal = IdealCamera(run)
    segment = ideal.segment
    fine = mesh_of(run.mesh, segment)
    if fine is None or run.stream is None:
        raise ResultError(f"{path.parent}: has no mesh")
    mesh = textured(fine, recording, run, run.stream, segment, triangles=_TRIANGLES, texels=_TEXELS)
    others = sorted(set(ideal.poses) - set(ideal.keyframes))
    chosen = set(others[:: max(1, len(others) // _FRAMES)][:_FRAMES])
    for frame, _, pixels, _ in rectified_images(recording, camera_of(recording), chosen):
        image = ideal.image(frame, pixels)
        seen = view_mesh(mesh.positions, mesh.triangles, ideal.camera, ideal.poses[frame])
        inside = seen.triangles >= 0
        yield _score(_rendered(mesh, seen.triangles, seen.shares), _in_colour(image), inside)


def _rendered(mesh: TexturedMesh, triangles: np.ndarray, shares: np.ndarray) -> F32:
    """(H, W, 3) what the mesh shows.   triangles: (H, W), -1: none.   shares: (H, W, 2)."""
    corners = mesh.uvs[mesh.triangles[np.maximum(triangles, 0)]]
    first = 1.0 - shares.sum(axis=-1, keepdims=True)
    uv = corners[..., 0, :] * first + (corners[..., 1:, :] * shares[..., None]).sum(axis=-2)
    at = (uv * len(mesh.texture) - 0.5).astype(np.float32)
    return np.asarray(cv2.remap(mesh.texture, at[..., 0], at[..., 1], cv2.INTER_LINEAR), np.float32)


def _in_colour(image: U8) -> F32:
    colour = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    return colour.astype(np.float32)


def _score(drawn: F32, image: F32, inside: BoolArray) -> _Score:
    factors = np.median(image[inside] / np.maximum(drawn[inside], 1.0), axis=0)
    difference = float(np.abs(drawn * factors - image)[inside].mean())
    a, b, covered = (
        cv2.resize(each, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        for each in (drawn.mean(axis=2), image.mean(axis=2), inside.astype(np.float32))
    )
    within = cv2.erode((covered > 0.999).astype(np.uint8), np.ones((_WINDOW, _WINDOW))) > 0
    spread_a, spread_b = _mean(a * a) - _mean(a) ** 2, _mean(b * b) - _mean(b) ** 2
    zncc = (_mean(a * b) - _mean(a) * _mean(b)) / np.sqrt(np.maximum(spread_a * spread_b, 1.0))
    textured_windows = spread_b > _LEAST_VARIANCE
    return _Score(
        float(inside.mean()),
        float(zncc[within & textured_windows].mean()),
        float(np.where(within, zncc, 0.0)[textured_windows].mean()),
        difference,
    )


def _mean(image: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.blur(image, (_WINDOW, _WINDOW)))
