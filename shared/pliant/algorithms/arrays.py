"""Records of arrays whose dtype and shape are part of their type, and are checked.

``points_px: Annotated[F32, Shape("N", 2)]`` means float32 of shape (N, 2).  Within one record the
same letter is the same size.  Algorithms exchange such records; messages are such records with a
header, so that what is computed is what is sent.
"""

from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, TypeAlias, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

U8: TypeAlias = NDArray[np.uint8]
U16: TypeAlias = NDArray[np.uint16]
U32: TypeAlias = NDArray[np.uint32]
U64: TypeAlias = NDArray[np.uint64]
I32: TypeAlias = NDArray[np.int32]
I64: TypeAlias = NDArray[np.int64]
F32: TypeAlias = NDArray[np.float32]
F64: TypeAlias = NDArray[np.float64]
BoolArray: TypeAlias = NDArray[np.bool_]


class Shape(tuple[int | str, ...]):
    """Sizes of an array: an int is fixed, a letter is a size named within its record."""

    __slots__ = ()

    def __new__(cls, *sizes: int | str) -> "Shape":
        return super().__new__(cls, sizes)


@dataclass(frozen=True)
class ArrayField:
    """The annotation of an array field of a record."""

    name: str
    dtype: np.dtype[Any]
    shape: Shape


@cache
def array_fields(record: type) -> tuple[ArrayField, ...]:
    """The array fields of a record class, in the order in which they are declared."""
    found: list[ArrayField] = []
    for name, hint in get_type_hints(record, include_extras=True).items():
        if get_origin(hint) is not Annotated:
            continue
        array_type, shape = get_args(hint)[:2]
        if isinstance(shape, Shape):
            found.append(ArrayField(name, np.dtype(_scalar_type(array_type)), shape))
    return tuple(found)


def _scalar_type(array_type: Any) -> Any:
    # NDArray[X] is ndarray[shape, dtype[X]] up to numpy 2.4, and an alias with argument X since.
    *_, last = get_args(array_type)
    return get_args(last)[0] if get_args(last) else last


def with_bits(values: F32, bits: int) -> F32:
    """Finite numbers to that many significant bits, 1 to 23: what is left of them takes little room
    where it is compressed."""
    dropped = 24 - bits
    whole = np.ascontiguousarray(values).view(np.uint32) + np.uint32(1 << (dropped - 1))
    return (whole >> np.uint32(dropped) << np.uint32(dropped)).view(np.float32)


def check_arrays(record: Any) -> None:
    """Raise ValueError, naming the field, where an array differs from its annotation."""
    sizes: dict[str, tuple[int, str]] = {}
    for spec in array_fields(type(record)):
        value = getattr(record, spec.name)
        if not isinstance(value, np.ndarray) or value.dtype != spec.dtype:
            found = getattr(value, "dtype", type(value).__name__)
            raise ValueError(f"{spec.name}: expected an array of {spec.dtype}, got {found}")
        if value.ndim != len(spec.shape):
            raise ValueError(
                f"{spec.name}: expected {len(spec.shape)} dimensions, got {value.ndim}"
            )
        for size, expected in zip(value.shape, spec.shape, strict=True):
            if isinstance(expected, str):
                known, owner = sizes.setdefault(expected, (size, spec.name))
                if known != size:
                    raise ValueError(
                        f"{spec.name}: size {expected} is {size}, in {owner} it is {known}"
                    )
            elif size != expected:
                raise ValueError(
                    f"{spec.name}: expected shape {tuple(spec.shape)}, got {value.shape}"
                )
