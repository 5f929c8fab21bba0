"""The state of a service as bytes and back, exactly, from which a restarted service continues.

A tree of our own objects, containers, numpy arrays and random generators.  A file from elsewhere
can run no code of its own: of the rooms that touch neither files nor sockets, records are made
again and the classes listed here, without a call of their code, and none gets an attribute in the
place of a method.  What is shared stays shared; arrays keep their layout, which decides how a
kernel is compiled.

What never changes and is large, such as the samples of a whole run, may be stored once and named in
every state: see ``Constants``.

A state is valid only for the release that made it, because it does not describe its objects.
"""

import hashlib
import importlib
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from functools import cached_property
from typing import Any, Protocol, cast

import msgpack
import numpy as np
from pydantic import BaseModel

from pliant.algorithms.inertial.samples import BLOCK_BYTES, bytes_of
from pliant.errors import StateError
from pliant.version import __version__

STATE_VERSION = 3

_ROOMS = (
    *("pliant.algorithms.", "pliant.messages.types"),
    *("pliant.map_history", "pliant.map_depth"),
)
_CLASSES = {
    *("ExtremaTracker", "BriefExtractor", "Mapper", "BootstrapMapper", "Localiser", "Atlas"),
    *("ActiveMap", "EarlierSegments", "Landmarks", "TrackLinks", "Window", "FramePoses"),
    "Journal",
    *("SurfelTracker", "MapDepth", "CurrentMap", "MapHistory", "_PointTable"),
}
"""Classes that are neither dataclasses, named tuples, nor parameters."""
_FUNCTIONS = {"no_stages"}
_CONSTANT = {"GyroSignal", "ImuSamples"}
"""Records that never change: a state names large ones where there is a store for them."""

_PLAIN = (type(None), bool, float, str, bytes)
_LIMIT = 1 << 62


class Constants(Protocol):
    """A store of records that never change, beside the states that name them."""

    def keep(self, record: Any) -> str:
        """Store a record if it is new; returns its name."""
        ...

    def kept(self, name: str) -> Any:
        """The record of this name.  Raises StateError if there is none."""
        ...


def save_state(root: Any, constants: Constants | None = None) -> bytes:
    """The bytes of an object and all that it holds, but for what goes to ``constants``.

    Raises StateError for what cannot be kept.
    """
    writer = _Writer(constants)
    top = writer.reference(root)
    header = [STATE_VERSION, __version__, _schema(writer.classes)]
    packed = msgpack.packb([*header, top, writer.nodes], use_bin_type=True)
    assert isinstance(packed, bytes)
    return packed


def load_state(data: bytes, constants: Constants | None = None) -> Any:
    """The object in ``data``.  Raises StateError for all that ``save_state`` did not make, also
    in another release, or when its records had other fields.

    constants: those that it was saved with.
    """
    try:
        version, *content = msgpack.unpackb(data, raw=False, strict_map_key=False)
    except Exception as error:  # msgpack raises many unrelated types on broken bytes
        raise StateError(f"not a saved state: {error}") from None
    if version != STATE_VERSION:
        raise StateError(f"a state of version {version}, this is version {STATE_VERSION}")
    try:
        release, schema, top, nodes = content
        if release != __version__:
            raise StateError(
                f"a state of pliant {release}, this is {__version__}: resume with that release, "
                "or start again"
            )
        if schema != _schema(_find(*n[1:3]) for n in nodes if n[0] in ("object", "named", "model")):
            raise StateError("a state with other fields than in this release: start again")
        return _Reader(nodes, constants).value(top)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, ImportError) as error:
        raise StateError(f"a broken state: {error}") from None


class _Writer:
    """Numbers every object that it meets; ``nodes`` holds them in that order."""

    def __init__(self, constants: Constants | None) -> None:
        self.nodes: list[Any] = []
        self._constants = constants
        self.classes: set[type] = set()
        self._numbers: dict[int, int] = {}
        self._held: list[Any] = []  # an id is only unique while its object lives

    def reference(self, value: Any) -> Any:
        """A plain value as it is; else ``[number]`` of its node."""
        if type(value) in _PLAIN or (type(value) is int and abs(value) < _LIMIT):
            return value
        number = self._numbers.get(id(value))
        if number is None:
            number = len(self.nodes)
            self._numbers[id(value)] = number
            self._held.append(value)
            self.nodes.append(None)
            self.nodes[number] = self._node(value)
        return [number]

    def _node(self, value: Any) -> list[Any]:
        kind = type(value)
        if kind is int:
            return ["int", str(value)]
        if isinstance(value, np.ndarray):
            return _array_node(cast("np.ndarray[Any, Any]", value))
        if isinstance(value, np.generic):
            return ["scalar", value.dtype.str, value.tobytes()]
        if isinstance(value, np.random.Generator):
            state = value.bit_generator.state
            return ["generator", state["bit_generator"], self.reference(state)]
        if isinstance(value, BaseModel):
            return ["model", *self._class(kind), value.model_dump(mode="json")]
        if kind in (list, tuple, deque):
            more = [value.maxlen] if kind is deque else []
            return [kind.__name__, [self.reference(item) for item in value], *more]
        if kind is dict:
            pairs = cast("dict[Any, Any]", value).items()
            return ["dict", [[self.reference(k), self.reference(v)] for k, v in pairs]]
        if isinstance(value, tuple):  # a named one
            return ["named", *self._class(kind), [self.reference(item) for item in value]]
        if callable(value) and hasattr(value, "__qualname__"):
            return ["name", *_name(value)]
        is_constant = kind.__name__ in _CONSTANT and bytes_of(value) >= BLOCK_BYTES
        if is_constant and self._constants is not None:
            return ["constant", self._constants.keep(value)]
        attributes = {key: self.reference(item) for key, item in _attributes(value).items()}
        return ["object", *self._class(kind), attributes]

    def _class(self, kind: type) -> tuple[str, str]:
        self.classes.add(kind)
        return _name(kind)


class _Reader:
    def __init__(self, nodes: list[Any], constants: Constants | None) -> None:
        self._nodes = nodes
        self._constants = constants
        self._made: dict[int, Any] = {}

    def value(self, reference: Any) -> Any:
        if not isinstance(reference, list):
            return reference
        (number,) = reference
        if number not in self._made:
            self._make(number, *self._nodes[number])
        return self._made[number]

    def _make(self, number: int, kind: str, *content: Any) -> None:
        made = self._made
        if kind == "list":
            made[number] = target = list[Any]()
            target += [self.value(item) for item in content[0]]
        elif kind == "deque":
            made[number] = queue = deque[Any](maxlen=content[1])
            queue.extend(self.value(item) for item in content[0])
        elif kind == "dict":
            made[number] = table = dict[Any, Any]()
            for key, item in content[0]:
                table[self.value(key)] = self.value(item)
        elif kind == "object":
            own = _find(*content[:2])
            made[number] = instance = object.__new__(own)
            for key, item in content[2].items():
                if callable(getattr(own, key, None)):
                    raise ValueError(f"{own.__name__}.{key} is a method")
                object.__setattr__(instance, key, self.value(item))
        elif kind in ("tuple", "named"):
            items = [self.value(item) for item in content[-1]]
            made[number] = tuple(items) if kind == "tuple" else _named(content, items)
        else:
            made[number] = self._leaf(kind, *content)

    def _leaf(self, kind: str, *content: Any) -> Any:
        if kind == "int":
            return int(content[0])
        if kind == "array":
            return _array(*content)
        if kind == "scalar":
            return np.frombuffer(content[1], np.dtype(content[0]))[0]
        if kind == "generator":
            bits = {"PCG64": np.random.PCG64, "PCG64DXSM": np.random.PCG64DXSM}[content[0]]()
            bits.state = self.value(content[1])
            return np.random.Generator(bits)
        if kind == "model":
            parameters: type[BaseModel] = _find(*content[:2])
            return parameters.model_validate(content[2])
        if kind == "name":
            return _find(*content)
        if kind == "constant" and self._constants is not None:
            return self._constants.kept(content[0])
        raise ValueError(f"a node of kind {kind}")


def _array_node(array: np.ndarray[Any, Any]) -> list[Any]:
    if array.dtype.hasobject:
        raise StateError(f"an array of {array.dtype} cannot be kept")
    order = "C" if array.flags.c_contiguous else "F"
    if not (array.flags.c_contiguous or array.flags.f_contiguous):
        raise StateError(f"an array of shape {array.shape} that is a view with gaps cannot be kept")
    kind: Any = array.dtype.descr if array.dtype.names else array.dtype.str
    flat = (array if order == "C" else array.T).reshape(-1)
    raw = flat.view(np.uint8).data if array.size else b""  # not copied before it is packed
    return ["array", kind, list(array.shape), order, array.flags.writeable, raw]


def _array(kind: Any, shape: list[int], order: Any, writeable: bool, raw: bytes) -> Any:
    described = kind if isinstance(kind, str) else [tuple(field) for field in kind]
    array = np.frombuffer(raw, np.dtype(described)).reshape(shape, order=order).copy(order)
    array.flags.writeable = writeable
    return array


def _named(content: Any, items: list[Any]) -> Any:
    own = _find(*content[:2])
    if len(items) != len(own._fields):
        raise ValueError(f"{len(items)} values for {own.__name__}")
    return tuple.__new__(own, items)


def _name(thing: Any) -> tuple[str, str]:
    module, name = str(thing.__module__), str(thing.__qualname__)
    if not (module.startswith(_ROOMS) and name.isidentifier() and _is_listed(thing)):
        raise StateError(f"{module}.{name} cannot be kept: it is no record, and not listed here")
    return module, name


def _find(module: str, name: str) -> Any:
    found = None
    if module.startswith(_ROOMS) and name.isidentifier():
        found = getattr(importlib.import_module(module), name)
    if found is None or getattr(found, "__module__", "") != module or not _is_listed(found):
        raise ValueError(f"{module}.{name} is none of those that are kept")
    return found


def _is_listed(thing: Any) -> bool:
    """Whether it is a record, or a class or function listed above."""
    if not isinstance(thing, type):
        return getattr(thing, "__qualname__", "") in _FUNCTIONS
    return (
        is_dataclass(thing)
        or (issubclass(thing, tuple) and hasattr(thing, "_fields"))
        or issubclass(thing, BaseModel)
        or thing.__name__ in _CLASSES
    )


def _schema(classes: Iterable[type]) -> str:
    """Eight hexadecimal digits of the fields that records of these classes have."""
    lines: set[str] = set()
    for own in classes:
        declared: Mapping[str, Any] = {}
        if issubclass(own, BaseModel):
            declared = {name: info.annotation for name, info in own.model_fields.items()}
        elif issubclass(own, tuple):
            declared = own.__annotations__
        elif is_dataclass(own):
            declared = {field.name: field.type for field in fields(own)}
        lines |= {f"{own.__module__}.{own.__name__}.{n}: {kind}" for n, kind in declared.items()}
    return hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest()[:8]


def _attributes(value: Any) -> Mapping[str, Any]:
    if hasattr(value, "__dict__"):
        own = type(value)
        return {
            name: item
            for name, item in vars(value).items()
            if not isinstance(getattr(own, name, None), cached_property)  # found again
        }
    if is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in fields(value)}
    raise StateError(f"{type(value).__name__} cannot be kept")
