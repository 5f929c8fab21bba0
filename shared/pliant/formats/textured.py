"""A mesh with a texture as files for others: glTF 2.0 in one file, or OBJ with MTL and PNG."""

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, I32, U8, Shape
from pliant.formats.text import write_bytes
from pliant.version import __version__

_FLOAT, _UNSIGNED = 5126, 5125
_VERTICES, _INDICES = 34962, 34963
_UPRIGHT = (1.0, 0.0, 0.0, 0.0)
"""Half a turn about x, as a quaternion x, y, z, w: glTF has y upwards, the first camera down."""


@dataclass(frozen=True, kw_only=True)
class TexturedMesh:
    """positions, normals: world frame.    uvs: (0, 0) at the outer corner of the first texel.

    triangles: rows of the vertices, anticlockwise from outside.    texture: RGB.
    """

    positions: Annotated[F32, Shape("V", 3)]
    normals: Annotated[F32, Shape("V", 3)]
    uvs: Annotated[F32, Shape("V", 2)]
    triangles: Annotated[I32, Shape("T", 3)]
    texture: Annotated[U8, Shape("H", "W", 3)]


def write_glb(path: Path, mesh: TexturedMesh) -> None:
    """Binary glTF 2.0 with the texture inside; equal meshes give equal bytes.  Raises ResultError.

    The colours are photographs, which include their light: the material needs none.
    """
    blobs = [mesh.positions.astype("<f4").tobytes(), mesh.normals.astype("<f4").tobytes(),
             mesh.uvs.astype("<f4").tobytes(), mesh.triangles.astype("<u4").tobytes(),
             _png(mesh.texture)]  # fmt: skip
    views: list[dict[str, int]] = []
    offset = 0
    for blob, target in zip(blobs, (_VERTICES,) * 3 + (_INDICES, 0), strict=True):
        view = {"buffer": 0, "byteOffset": offset, "byteLength": len(blob)}
        views.append({**view, "target": target} if target else view)
        offset += len(blob) + -len(blob) % 4
    bounds = {
        "min": mesh.positions.min(axis=0).tolist(),
        "max": mesh.positions.max(axis=0).tolist(),
    }
    vertices, corners = len(mesh.positions), mesh.triangles.size
    document = {
        "asset": {"version": "2.0", "generator": f"pliant {__version__}"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": _UPRIGHT}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2},
                        "indices": 3,
                        "material": 0,
                    }
                ]
            }
        ],
        "accessors": [
            _accessor(0, _FLOAT, vertices, "VEC3") | bounds,
            _accessor(1, _FLOAT, vertices, "VEC3"),
            _accessor(2, _FLOAT, vertices, "VEC2"),
            _accessor(3, _UNSIGNED, corners, "SCALAR"),
        ],
        "materials": [
            {
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0},
                "extensions": {"KHR_materials_unlit": {}},
                "doubleSided": True,
            }
        ],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 4, "mimeType": "image/png"}],
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    body = b"".join(blob + bytes(-len(blob) % 4) for blob in blobs)
    header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(body))
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(body), b"BIN\0") + body
    write_bytes(path, header + chunks)


def write_obj(folder: Path, mesh: TexturedMesh) -> None:
    """``mesh.obj``, ``mesh.mtl`` and ``mesh.png`` in a folder that is there; world frame.

    Raises ResultError.
    """
    write_bytes(folder / "mesh.png", _png(mesh.texture))
    material = ["newmtl photographs", "Ka 1 1 1", "Kd 1 1 1", "Ks 0 0 0", "illum 0"]
    write_bytes(folder / "mesh.mtl", _text([*material, "map_Kd mesh.png"]))
    lines = ["mtllib mesh.mtl", "usemtl photographs"]
    lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in mesh.positions.tolist()]
    lines += [f"vt {u:.7g} {1.0 - v:.7g}" for u, v in mesh.uvs.tolist()]
    lines += [f"vn {x:.5g} {y:.5g} {z:.5g}" for x, y, z in mesh.normals.tolist()]
    for corners in (mesh.triangles + 1).tolist():
        lines.append("f " + " ".join(f"{c}/{c}/{c}" for c in corners))
    write_bytes(folder / "mesh.obj", _text(lines))


def _accessor(view: int, kind: int, count: int, shape: str) -> dict[str, Any]:
    return {"bufferView": view, "componentType": kind, "count": count, "type": shape}


def _text(lines: list[str]) -> bytes:
    return "".join(f"{line}\n" for line in lines).encode("ascii")


def _png(pixels: U8) -> bytes:
    _, data = cv2.imencode(".png", np.ascontiguousarray(pixels[:, :, ::-1]))
    return data.tobytes()
