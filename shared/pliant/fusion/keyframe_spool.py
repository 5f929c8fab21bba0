"""Keyframes on disk: images, observations and surfaces; memory holds only their positions."""

import tempfile
from dataclasses import dataclass
from threading import Lock

import numpy as np

from pliant.algorithms.arrays import F32, I64, U8
from pliant.algorithms.meshing.rendering import DrawnTriangles
from pliant.algorithms.stereo.views import DenseDepth

_ID_BYTES = np.dtype(np.int64).itemsize
_PIXEL_BYTES = 2 * np.dtype(np.float32).itemsize
_LARGEST = 6e4
"""In half precision."""


@dataclass(frozen=True)
class _Place:
    """room: bytes that there may be, the first ``size`` of which are used."""

    offset: int
    size: int
    room: int


class KeyframeSpool:
    """A temporary file; the last data of a keyframe count.  A context manager.

    Threads may read at the same time.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(prefix="pliant-keyframes-")  # noqa: SIM115
        self._lock = Lock()  # between seeking and reading
        self._images: dict[int, _Place] = {}
        self._masks: dict[int, _Place] = {}
        self._observations: dict[int, _Place] = {}
        self._surfaces: dict[int, _Place] = {}
        self._greys: dict[int, _Place] = {}
        self._depths: dict[int, _Place] = {}

    def __enter__(self) -> "KeyframeSpool":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        with self._lock:
            return self._file.seek(0, 2)

    def put_image(self, keyframe: int, jpeg: bytes) -> None:
        """Keep the image of a keyframe."""
        self._put(self._images, keyframe, jpeg)

    def put_mask(self, keyframe: int, mask: bytes) -> None:
        """Keep the mask of that image."""
        self._put(self._masks, keyframe, mask)

    def put_observations(self, keyframe: int, point_ids: I64, points_px: F32) -> None:
        """Keep what a keyframe observes: (N,) and (N, 2)."""
        self._put(self._observations, keyframe, point_ids.tobytes() + points_px.tobytes())

    def put_surface(self, keyframe: int, drawn: DrawnTriangles) -> None:
        """Keep what a keyframe's depth map shows."""
        columns = (drawn.points_px, drawn.inverse_depths[:, None], drawn.sigmas[:, None])
        corners = np.concatenate(columns, axis=1)
        count = np.int64(len(corners)).tobytes()
        self._put(self._surfaces, keyframe, count + corners.tobytes() + drawn.triangles.tobytes())

    def put_grey(self, keyframe: int, grey: U8) -> None:
        """Keep the image of a keyframe as its depth is swept: (H, W)."""
        self._put(self._greys, keyframe, grey.tobytes())

    def put_depth(self, keyframe: int, depth: DenseDepth) -> None:
        """Keep the dense depth of a keyframe, inverse depths in float16, confidences in 1/255."""
        w = depth.inverse_depths
        # Whatever the scale of the map: half precision is coarse near 0 and ends at 65504.
        unit = float(np.median(w[w > 0.0])) if (w > 0.0).any() else 1.0
        shape = np.array(w.shape, np.int64).tobytes() + np.float64(unit).tobytes()
        shares = np.minimum(w / np.float32(unit), np.float32(_LARGEST)).astype(np.float16)
        levels = np.rint(255.0 * depth.confidences).astype(np.uint8)
        self._put(self._depths, keyframe, shape + shares.tobytes() + levels.tobytes())

    def keyframes(self) -> list[int]:
        """Ids of the keyframes whose observations are here, ascending."""
        return sorted(self._observations)

    def image(self, keyframe: int) -> bytes:
        """The image of a keyframe; empty without one."""
        place = self._images.get(keyframe)
        return self._read(place) if place is not None else b""

    def mask(self, keyframe: int) -> bytes:
        """The mask of that image; empty where it has none."""
        place = self._masks.get(keyframe)
        return self._read(place) if place is not None else b""

    def observations(self, keyframe: int) -> tuple[I64, F32]:
        """Point ids (N,) and pixels (N, 2) of a keyframe.  KeyError without any."""
        raw = self._read(self._observations[keyframe])
        count = len(raw) // (_ID_BYTES + _PIXEL_BYTES)
        ids = np.frombuffer(raw, np.int64, count).copy()
        pixels = np.frombuffer(raw, np.float32, 2 * count, count * _ID_BYTES)
        return ids, pixels.reshape(-1, 2).copy()

    def surface(self, keyframe: int) -> DrawnTriangles:
        """The triangles of a keyframe's depth map.  KeyError without any."""
        raw = self._read(self._surfaces[keyframe])
        count = int(np.frombuffer(raw, np.int64, 1)[0])
        corners = np.frombuffer(raw, np.float32, 4 * count, _ID_BYTES).reshape(-1, 4)
        triangles = np.frombuffer(raw, np.int32, offset=_ID_BYTES + corners.nbytes).reshape(-1, 3)
        return DrawnTriangles(
            triangles=triangles.copy(),
            points_px=corners[:, :2].copy(),
            inverse_depths=corners[:, 2].copy(),
            sigmas=corners[:, 3].copy(),
        )

    def grey(self, keyframe: int) -> U8:
        """The image of a keyframe as its depth is swept, its rows behind each other: (H W,)."""
        return np.frombuffer(self._read(self._greys[keyframe]), np.uint8)

    def depth(self, keyframe: int) -> DenseDepth:
        """The dense depth of a keyframe.  KeyError without any."""
        raw = self._read(self._depths[keyframe])
        height, width = np.frombuffer(raw, np.int64, 2).tolist()
        unit = np.frombuffer(raw, np.float64, 1, 16)[0]
        shares = np.frombuffer(raw, np.float16, height * width, 24).reshape(height, width)
        levels = np.frombuffer(raw, np.uint8, offset=24 + shares.nbytes).reshape(height, width)
        return DenseDepth(
            inverse_depths=shares.astype(np.float32) * np.float32(unit),
            confidences=levels.astype(np.float32) / np.float32(255.0),
        )

    def _put(self, places: dict[int, _Place], keyframe: int, data: bytes) -> None:
        """In the place of the earlier data if there is room."""
        old = places.get(keyframe)
        with self._lock:
            if old is not None and len(data) <= old.room:
                self._file.seek(old.offset)
                places[keyframe] = _Place(old.offset, len(data), old.room)
            else:
                places[keyframe] = _Place(self._file.seek(0, 2), len(data), len(data))
            self._file.write(data)

    def _read(self, place: _Place) -> bytes:
        with self._lock:
            self._file.seek(place.offset)
            return self._file.read(place.size)
