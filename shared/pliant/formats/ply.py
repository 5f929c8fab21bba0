"""Binary little-endian PLY: points or a triangle mesh, with colours and normals."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, I32, U8
from pliant.errors import ResultError
from pliant.formats.text import shorten, write_bytes

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "<i2",
    "int16": "<i2",
    "ushort": "<u2",
    "uint16": "<u2",
    "int": "<i4",
    "int32": "<i4",
    "uint": "<u4",
    "uint32": "<u4",
    "float": "<f4",
    "float32": "<f4",
    "double": "<f8",
    "float64": "<f8",
}
_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
_LONGEST_HEADER = 65536
_CLOSED = "closed"


@dataclass(frozen=True, kw_only=True)
class PlyData:
    """points: (N, 3).  colours: (N, 3) RGB.  normals: (N, 3).  faces: (F, 3) rows of points.

    closed: rows of points that close holes, ascending; none if the file does not mark them.
    """

    points: F32
    colours: U8 | None
    normals: F32 | None
    faces: I32 | None
    closed: I32


def write_ply(
    path: Path,
    points: F32,
    colours: U8 | None = None,
    *,
    normals: F32 | None = None,
    faces: I32 | None = None,
    closed: I32 | None = None,
) -> None:
    """Write (N, 3) points; equal arrays give equal bytes.  See PlyData for the shapes.

    Raises ValueError on wrong shapes, values that are not finite or corners that do not exist,
    ResultError if the file cannot be written.
    """
    fields: list[tuple[str, str]] = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    if normals is not None:
        fields += [("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4")]
    if colours is not None:
        fields += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    if closed is not None:
        fields.append((_CLOSED, "u1"))
    rows = np.zeros(len(points), np.dtype(fields))
    named = (("points", points, "xyz"), ("normals", normals, ("nx", "ny", "nz")))
    for name, array, columns in (*named, ("colours", colours, ("red", "green", "blue"))):
        if array is None:
            continue
        if array.shape != (len(points), 3):
            raise ValueError(f"{name}: expected shape ({len(points)}, 3), got {array.shape}")
        if not np.all(np.isfinite(array)):
            raise ValueError(f"{name}: a value is not finite")
        for index, column in enumerate(columns):
            rows[column] = array[:, index]
    if closed is not None:
        rows[_CLOSED][closed] = 1
    names = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property {names[kind]} {name}" for name, kind in fields]
    body = rows.tobytes()
    if faces is not None:
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise ValueError(f"faces: expected shape (F, 3), got {faces.shape}")
        if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < len(points):
            raise ValueError("faces: a corner is not a point")
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        triangles = np.zeros(len(faces), _FACE)
        triangles["count"], triangles["corners"] = 3, faces
        body += triangles.tobytes()
    header.append("end_header\n")
    write_bytes(path, "\n".join(header).encode("ascii") + body)


def read_ply(path: Path) -> PlyData:
    """Read points and triangles of a binary little-endian PLY.

    Other scalar properties of points are passed over.  Raises ResultError, in one line, for text
    or big-endian PLY, faces that are not triangles, elements it does not know, a file that is
    shorter or longer than by its header, and corners that are not points.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ResultError(f"{path}: cannot be read ({error.strerror})") from None
    try:
        return _parse(data)
    except ValueError as error:
        raise ResultError(f"{path}: {error}") from None


def _parse(data: bytes) -> PlyData:
    end = data.find(b"end_header\n", 0, _LONGEST_HEADER)
    if not data.startswith(b"ply\n") or end < 0:
        raise ValueError("is not a PLY file")
    vertices, faces, fields = _parse_header(data[:end].decode("ascii", "replace").splitlines()[1:])
    body = memoryview(data)[end + len(b"end_header\n") :]
    kind = np.dtype(fields)
    expected = vertices * kind.itemsize + (faces or 0) * _FACE.itemsize
    if len(body) != expected:
        raise ValueError(f"holds {len(body)} bytes of data, its header promises {expected}")
    rows = np.frombuffer(body, kind, count=vertices)
    points = _columns(rows, ("x", "y", "z"), np.float32)
    if points is None:
        raise ValueError("its points have no x, y, z")
    if not np.all(np.isfinite(points)):
        raise ValueError("a point is not finite")
    triangles = None
    if faces is not None:
        table = np.frombuffer(body, _FACE, count=faces, offset=vertices * kind.itemsize)
        if np.any(table["count"] != 3):
            raise ValueError("a face is not a triangle")
        triangles = table["corners"].astype(np.int32)
        if faces and not 0 <= int(triangles.min()) <= int(triangles.max()) < vertices:
            raise ValueError("a face has a corner that is not a point")
    return PlyData(
        points=points,
        colours=_columns(rows, ("red", "green", "blue"), np.uint8),
        normals=_columns(rows, ("nx", "ny", "nz"), np.float32),
        faces=triangles,
        closed=_marked(rows),
    )


def _marked(rows: Any) -> I32:
    """The rows whose points are marked."""
    if _CLOSED not in (rows.dtype.names or ()):
        return np.zeros(0, np.int32)
    return np.flatnonzero(rows[_CLOSED]).astype(np.int32)


def _parse_header(lines: list[str]) -> tuple[int, int | None, list[tuple[str, str]]]:
    counts: dict[str, int] = {}
    fields: list[tuple[str, str]] = []
    element = ""
    for line in lines:
        match line.split():
            case [] | ["comment" | "obj_info", *_] | ["format", "binary_little_endian", "1.0"]:
                pass
            case ["format", *_]:
                raise ValueError("only binary_little_endian 1.0 is read")
            case ["element", "vertex" | "face" as element, count] if (
                count.isascii() and count.isdigit() and len(count) < 12 and element not in counts
            ):
                counts[element] = int(count)
            case ["property", kind, name] if element == "vertex" and kind in _TYPES:
                if name in (known for known, _ in fields):
                    raise ValueError(f"property {shorten(name)} stands twice")
                fields.append((name, _TYPES[kind]))
            case [
                "property",
                "list",
                "uchar" | "uint8",
                "int" | "int32" | "uint" | "uint32",
                _,
            ] if element == "face":
                pass
            case _:
                raise ValueError(f"header line {shorten(line)} is not understood")
    if not lines or not lines[0].startswith("format") or list(counts)[:1] != ["vertex"]:
        raise ValueError("its header is incomplete")
    return counts["vertex"], counts.get("face"), fields


def _columns(rows: Any, names: tuple[str, ...], dtype: Any) -> Any:
    if not all(name in (rows.dtype.names or ()) for name in names):
        return None
    return np.stack([rows[name] for name in names], axis=1).astype(dtype)
