"""A mesh that deforms over time, as a glTF 2.0 file with one morph target for each key frame."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from pliant.algorithms.arrays import F64, I32, U8, U16, Shape
from pliant.formats.gltf import Glb


@dataclass(frozen=True, kw_only=True)
class AnimatedMesh:
    """V vertices at K key frames, K >= 2.

    times_s: increasing, the first is 0.    names: of the key frames.    colours: sRGB; None: white.
    triangles: rows of the vertices, anticlockwise from outside.
    """

    times_s: Annotated[F64, Shape("K")]
    names: list[str]
    positions: Annotated[F64, Shape("K", "V", 3)]
    triangles: Annotated[I32, Shape("T", 3)]
    colours: Annotated[U8, Shape("V", 3)] | None


def write_animated_glb(path: Path, mesh: AnimatedMesh, extras: dict[str, Any]) -> None:
    """The first key frame as the rest shape, and displacements from it as morph targets.

    At key frame k its own target has the weight 1 and all others 0, with linear interpolation
    between.  So vertices move on straight lines from key frame to key frame.  Positions are exact
    there but for the rounding of float32.  extras: what readers show of the object.
    Raises ResultError.
    """
    glb = Glb()
    rest, *moved = mesh.positions
    primitive: dict[str, Any] = {
        "attributes": {"POSITION": glb.vertices(rest.astype(np.float32), bounded=True)},
        "indices": glb.indices(mesh.triangles.astype(np.uint32)),
        "material": 0,
    }
    if mesh.colours is not None:
        primitive["attributes"]["COLOR_0"] = glb.vertices(_linear(mesh.colours))
    primitive["targets"] = [
        {"POSITION": glb.vertices((each - rest).astype(np.float32), bounded=True)} for each in moved
    ]
    keys = len(mesh.times_s)
    weights = np.eye(keys, dtype=np.float32)[:, 1:]
    sampler = {
        "input": glb.samples(mesh.times_s.astype(np.float32), bounded=True),
        "output": glb.samples(weights.ravel()),
        "interpolation": "LINEAR",
    }
    channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    glb.write(
        path,
        mesh={
            "primitives": [primitive],
            "weights": [0.0] * (keys - 1),
            "extras": {"targetNames": mesh.names[1:]},
        },
        material={},
        animations=[{"samplers": [sampler], "channels": [channel]}],
        extras=extras,
    )


def _linear(colours: U8) -> U16:
    """(V, 4) of sRGB with alpha 1: glTF's vertex colours are linear.  IEC 61966-2-1."""
    share = colours.astype(np.float64) / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    opaque = np.concatenate([linear, np.ones((len(linear), 1))], axis=1)
    return np.round(opaque * 65535.0).astype(np.uint16)
