"""Which keyframes are new or have left the window, and what they observe."""

from collections.abc import Sequence

import numpy as np

from pliant.algorithms.keyframe_delta import KeyframeDelta
from pliant.algorithms.mapping.map_store import MAPPED, Keyframe, PointRows


class KeyframeReport:
    """Remembers what has been told, and makes each KeyframeDelta."""

    def __init__(self, points: PointRows) -> None:
        self._points = points
        self._newest = -1
        self._settled = -1
        self._leaving: list[Keyframe] = []

    def leave(self, keyframes: Sequence[Keyframe]) -> None:
        """These keyframes, in the order of their ids, will not change any more."""
        self._leaving += [k for k in keyframes if k.id > self._settled]
        self._settled = max([self._settled, *(keyframe.id for keyframe in self._leaving)])

    def tell(self, newest: Keyframe | None) -> KeyframeDelta:
        """What has not been told yet.  newest: the last keyframe that was made, if any."""
        new = -1
        told = [(keyframe, True) for keyframe in self._leaving]
        self._leaving = []
        if newest is not None and newest.id > self._newest:
            new = self._newest = newest.id
            told.append((newest, False))
        ids, pixels = [np.zeros(0, np.int64)], [np.zeros((0, 2), np.float32)]
        for keyframe, _ in told:
            mapped = np.flatnonzero(self._points.state[keyframe.rows] == MAPPED)
            point_ids = self._points.ids[keyframe.rows[mapped]]
            order = np.argsort(point_ids)
            ids.append(point_ids[order])
            pixels.append(keyframe.points_px[mapped[order]])
        return KeyframeDelta(
            new=new,
            keyframe_ids=np.array([keyframe.id for keyframe, _ in told], np.int64),
            settled=np.array([settled for _, settled in told], np.bool_),
            counts=np.array([len(some) for some in ids[1:]], np.int32),
            point_ids=np.concatenate(ids),
            points_px=np.concatenate(pixels),
        )
