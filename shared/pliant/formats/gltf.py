"""Binary glTF 2.0: accessors in one buffer, with one mesh that needs no light."""

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, U16, U32
from pliant.formats.text import write_bytes
from pliant.version import __version__

_VERTICES, _INDICES = 34962, 34963
_UPRIGHT = (1.0, 0.0, 0.0, 0.0)
"""Half a turn about x, as a quaternion x, y, z, w: glTF has y upwards, the first camera down."""
_COMPONENTS = {"float32": 5126, "uint32": 5125, "uint16": 5123}
_SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


@dataclass
class Glb:
    """A file as it grows.  Every part of the buffer starts at a multiple of four bytes."""

    _accessors: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    _views: list[dict[str, int]] = field(default_factory=list[dict[str, int]])
    _body: bytearray = field(default_factory=bytearray)

    def vertices(self, rows: F32 | U16, *, bounded: bool = False) -> int:
        """Add (V, C) attributes of vertices and return the accessor.

        uint16 means 0 to 1.    bounded: with the extrema that glTF requires of positions.
        """
        return self._accessor(rows, _VERTICES, bounded=bounded)

    def indices(self, triangles: U32) -> int:
        """Add (T, 3) rows of vertices and return the accessor."""
        return self._accessor(triangles.reshape(-1, 1), _INDICES)

    def samples(self, values: F32, *, bounded: bool = False) -> int:
        """Add (N,) times or outputs of an animation; bounded: as glTF requires of times."""
        return self._accessor(values.reshape(-1, 1), 0, bounded=bounded)

    def view(self, blob: bytes, target: int = 0) -> int:
        """Add bytes and return their view."""
        view = {"buffer": 0, "byteOffset": len(self._body), "byteLength": len(blob)}
        self._views.append({**view, "target": target} if target else view)
        self._body += blob + bytes(-len(blob) % 4)
        return len(self._views) - 1

    def write(
        self, path: Path, *, mesh: dict[str, Any], material: dict[str, Any], **more: Any
    ) -> None:
        """Write one node with a mesh; equal content gives equal bytes.  Raises ResultError.

        mesh, material: of the document; the colours are photographs, which include their light, so
        the material is unlit.    more: of the document or, as ``extras``, of the node.
        """
        node = {"mesh": 0, "rotation": _UPRIGHT}
        if "extras" in more:
            node["extras"] = more.pop("extras")
        unlit = {"extensions": {"KHR_materials_unlit": {}}, "doubleSided": True}
        document = {
            "asset": {"version": "2.0", "generator": f"pliant {__version__}"},
            "extensionsUsed": ["KHR_materials_unlit"],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [node],
            "meshes": [mesh],
            "accessors": self._accessors,
            "materials": [{"pbrMetallicRoughness": {**material, "metallicFactor": 0.0}, **unlit}],
            **more,
            "bufferViews": self._views,
            "buffers": [{"byteLength": len(self._body)}],
        }
        text = json.dumps(document, separators=(",", ":")).encode("ascii")
        text += b" " * (-len(text) % 4)
        header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(self._body))
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(self._body), b"BIN\0")
        write_bytes(path, header + chunks + bytes(self._body))

    def _accessor(self, rows: F32 | U16 | U32, target: int, *, bounded: bool = False) -> int:
        little = rows.astype(rows.dtype.newbyteorder("<"), copy=False)
        accessor: dict[str, Any] = {
            "bufferView": self.view(little.tobytes(), target),
            "componentType": _COMPONENTS[rows.dtype.name],
            "count": len(rows),
            "type": _SHAPES[rows.shape[1]],
        }
        if rows.dtype == np.uint16:
            accessor["normalized"] = True
        if bounded:
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self._accessors.append(accessor)
        return len(self._accessors) - 1
