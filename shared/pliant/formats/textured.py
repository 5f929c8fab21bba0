"""A mesh with a texture as files for others: glTF 2.0 in one file, or OBJ with MTL and PNG."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, I32, U8, Shape
from pliant.formats.gltf import Glb
from pliant.formats.text import write_bytes


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
    """Write binary glTF with its texture; equal meshes give equal bytes.  Raises ResultError."""
    glb = Glb()
    attributes = {
        "POSITION": glb.vertices(mesh.positions, bounded=True),
        "NORMAL": glb.vertices(mesh.normals),
        "TEXCOORD_0": glb.vertices(mesh.uvs),
    }
    indices = glb.indices(mesh.triangles.astype(np.uint32))
    glb.write(
        path,
        mesh={"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]},
        material={"baseColorTexture": {"index": 0}},
        textures=[{"source": 0}],
        images=[{"bufferView": glb.view(_png(mesh.texture)), "mimeType": "image/png"}],
    )


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


def _text(lines: list[str]) -> bytes:
    return "".join(f"{line}\n" for line in lines).encode("ascii")


def _png(pixels: U8) -> bytes:
    _, data = cv2.imencode(".png", np.ascontiguousarray(pixels[:, :, ::-1]))
    return data.tobytes()
