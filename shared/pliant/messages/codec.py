"""Messages to msgpack and back.

A message is a map from field name to value; an array is ``[shape, raw little-endian bytes]`` with
the dtype that its type declares.  Nothing is done per element, so that an image costs one copy.
Decoding checks names, types, shapes and sizes; what does not fit raises ``MessageError``.
Unknown fields are passed over: they come from a newer writer.

For a link between machines images can be packed (``pliant.messages.packing``), and recordings have
arrays in planes (``pliant.messages.planes``): what comes out of ``decode`` is the same.
"""

import hashlib
import json
import math
import sys
from collections.abc import Iterable
from dataclasses import MISSING, fields
from functools import cache
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import msgpack
import numpy as np

from pliant.algorithms.arrays import ArrayField, array_fields
from pliant.errors import MessageError
from pliant.messages import packing, planes
from pliant.messages.types import Header, Rows

SCHEMA_VERSION = 2
"""1: ``tracks/extrema`` has maxima of curvature, too.  2: arrays of recordings are in planes."""

_UNPACKED_LIMIT = 1 << 30  # of what no topic limits

_M = TypeVar("_M", bound=Header)

if sys.byteorder != "little":  # pragma: no cover
    raise ImportError("pliant's wire format is little-endian and so must the machine be")


@cache
def scalars(message: type[Header]) -> dict[str, type]:
    """Fields of a message that are not arrays, and their types."""
    hints = get_type_hints(message)
    arrays = {spec.name for spec in array_fields(message)}
    return {f.name: hints[f.name] for f in fields(message) if f.name not in arrays}


@cache
def _required(message: type[Header]) -> frozenset[str]:
    return frozenset(f.name for f in fields(message) if f.default is f.default_factory is MISSING)


@cache
def _rows(message: type[Header]) -> dict[str, str]:
    """Fields of bytes that are rows of pixels, and the fields with their number."""
    hints = get_type_hints(message, include_extras=True)
    annotated = {n: get_args(h)[1] for n, h in hints.items() if get_origin(h) is Annotated}
    return {name: extra.field for name, extra in annotated.items() if isinstance(extra, Rows)}


def encode(message: Header, *, packed: bool = False) -> bytes:
    """The bytes of a message.  Raises ValueError, naming the field, for a wrong array.

    packed: make pixels smaller where that gains something.
    """
    values: dict[str, Any] = {name: getattr(message, name) for name in scalars(type(message))}
    if packed:
        for name, rows in _rows(type(message)).items():
            pixels = np.frombuffer(values[name], np.uint8)
            values[name] = packing.pack(pixels, values[rows]) or values[name]
    sizes: dict[str, int] = {}
    room = 4096 + sum(len(v) for v in values.values() if isinstance(v, bytes))
    for spec in array_fields(type(message)):
        array: np.ndarray[Any, Any] = getattr(message, spec.name)
        if array.dtype != spec.dtype:
            raise ValueError(f"{spec.name}: expected an array of {spec.dtype}, got {array.dtype}")
        _check_shape(spec, array.shape, sizes)
        flat = np.ascontiguousarray(array).reshape(-1).view(np.uint8) if array.size else None
        raw: Any = b"" if flat is None else flat.data
        if packed and flat is not None and array.dtype == np.uint8:
            raw = packing.pack(flat, array.shape[0]) or raw
        values[spec.name] = [list(array.shape), raw]
        room += array.nbytes + 64
    # Room for the whole message: a growing buffer would copy an image several times.
    packer = msgpack.Packer(use_bin_type=True, buf_size=room, unicode_errors="replace")
    packed = packer.pack(values)
    assert isinstance(packed, bytes)
    return packed


def decode(
    message: type[_M], data: bytes, *, max_bytes: int | None = None, views: bool = False
) -> _M:
    """The message in ``data``.  Raises MessageError for everything else.

    views: for who only looks at it; its arrays are read-only, and cost no copy.
    """
    if max_bytes is not None and len(data) > max_bytes:
        raise MessageError(
            f"{message.__name__}: {len(data)} bytes, more than the {max_bytes} allowed"
        )
    try:
        content = msgpack.unpackb(data, raw=False, use_list=True, strict_map_key=True)
    except Exception as error:  # msgpack raises many unrelated types on hostile bytes
        raise MessageError(f"{message.__name__}: not msgpack: {error}") from None
    if not isinstance(content, dict):
        raise MessageError(f"{message.__name__}: expected a map, got {type(content).__name__}")
    missing = _required(message) - content.keys()
    if missing:
        raise MessageError(f"{message.__name__}: without {', '.join(sorted(missing))}")
    values: dict[str, Any] = {}
    limit = _UNPACKED_LIMIT if max_bytes is None else max_bytes
    for name, expected in scalars(message).items():
        if name in content:
            if isinstance(content[name], msgpack.ExtType) and name in _rows(message):
                where = f"{message.__name__}.{name}"
                content[name] = packing.unpack(where, content[name], limit).tobytes()
                limit -= len(content[name])
            values[name] = _scalar(message, name, expected, content[name])
    sizes: dict[str, int] = {}
    for spec in array_fields(message):
        if spec.name in content:
            array = _array(message, spec, content[spec.name], sizes, limit)
            # 0.1 ms for an image: numba would compile every kernel once more for read-only views.
            values[spec.name] = array if views or array.flags.writeable else array.copy()
            if isinstance(content[spec.name][1], msgpack.ExtType):
                limit -= values[spec.name].nbytes
    return message(**values)


def schema(message: type[Header]) -> bytes:
    """A JSON description of a message for the recording: field name to type, dtype and shape."""
    described: dict[str, Any] = {
        n: getattr(t, "__name__", str(t)) for n, t in scalars(message).items()
    }
    for spec in array_fields(message):
        described[spec.name] = {"dtype": spec.dtype.str, "shape": list(spec.shape)}
    text = {"encoding": "msgpack", "version": SCHEMA_VERSION, "fields": described}
    return json.dumps(text, sort_keys=True).encode()


def schema_hash(messages: Iterable[type[Header]]) -> str:
    """Eight hexadecimal digits of the names, types and shapes of the messages' fields."""
    lines: list[str] = []
    for each in messages:
        lines += [f"{each.__name__}.{name}: {kind}" for name, kind in scalars(each).items()]
        lines += [f"{each.__name__}.{a.name}: {a.dtype.str} {a.shape}" for a in array_fields(each)]
    return hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest()[:8]


def _scalar(message: type, name: str, expected: Any, value: Any) -> Any:
    if type(value) is expected:
        return value
    if get_origin(expected) is tuple:
        (element, _) = get_args(expected)
        if isinstance(value, list) and all(type(item) is element for item in value):
            return tuple(value)
    elif expected is float and type(value) is int:
        return float(value)
    wanted = getattr(expected, "__name__", str(expected))
    raise MessageError(f"{message.__name__}.{name}: expected {wanted}, got {type(value).__name__}")


def _array(message: type, spec: ArrayField, value: Any, sizes: dict[str, int], limit: int) -> Any:
    where = f"{message.__name__}.{spec.name}"
    kinds = (bytes, msgpack.ExtType)
    if not (isinstance(value, list) and len(value) == 2 and isinstance(value[1], kinds)):
        raise MessageError(f"{where}: expected an array")
    shape, raw = value
    if not (isinstance(shape, list) and all(type(n) is int and n >= 0 for n in shape)):
        raise MessageError(f"{where}: bad shape {str(shape)[:80]}")
    try:
        _check_shape(spec, tuple(shape), sizes)
    except ValueError as error:
        raise MessageError(f"{message.__name__}.{error}") from None
    if isinstance(raw, msgpack.ExtType) and spec.dtype.itemsize > 1:
        raw = planes.whole(where, raw, spec.dtype.itemsize)
    if isinstance(raw, msgpack.ExtType):
        pixels = packing.unpack(where, raw, min(limit, math.prod(shape)))
        if pixels.size != math.prod(shape):
            raise MessageError(f"{where}: {pixels.size} bytes do not fill shape {shape}")
        return pixels.reshape(shape)
    if math.prod(shape) * spec.dtype.itemsize != len(raw):
        raise MessageError(f"{where}: {len(raw)} bytes do not fill shape {shape} of {spec.dtype}")
    try:
        return np.frombuffer(raw, spec.dtype).reshape(shape)
    except (ValueError, OverflowError):  # an empty array with an impossibly long side
        raise MessageError(f"{where}: bad shape {str(shape)[:80]}") from None


def _check_shape(spec: ArrayField, shape: tuple[int, ...], sizes: dict[str, int]) -> None:
    if len(shape) != len(spec.shape):
        raise ValueError(f"{spec.name}: expected {len(spec.shape)} dimensions, got {len(shape)}")
    for size, expected in zip(shape, spec.shape, strict=True):
        wanted = sizes.setdefault(expected, size) if isinstance(expected, str) else expected
        if size != wanted:
            raise ValueError(f"{spec.name}: size {expected} is {size}, expected {wanted}")
