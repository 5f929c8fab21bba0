"""The mapper of a camera whose calibration is a guess.

A map that begins with a wrong focal length loses landmarks and poses for good.  So a first map is
made on trial, only to estimate the calibration, while its frames wait as they do for a start.  Once
the focal length is certain, or no more frames can wait, the map begins again with all of them and
with the estimated camera.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.kept_keyframe import KeptKeyframe
from pliant.algorithms.map_delta import TRACKING, WAITING, KeyframeDelta, MapDelta
from pliant.algorithms.mapping.first_map import keep_newest
from pliant.algorithms.mapping.frame import Frame
from pliant.algorithms.mapping.global_adjustment import GlobalAdjustment
from pliant.algorithms.mapping.kept_map import known_camera
from pliant.algorithms.mapping.localiser import Localiser
from pliant.algorithms.mapping.mapper import Mapper
from pliant.algorithms.mapping.parameters import MappingParameters
from pliant.algorithms.mapping.self_calibration import is_guess, widened
from pliant.algorithms.stages import StageTimer, no_stages

_KNOWN = 0.01
"""Standard deviation of the log focal length below which the final map can begin."""


class _Taken(NamedTuple):
    """A frame that has been mapped on trial, or has only been localised."""

    frame: Frame
    is_mapped: bool = True

    @property
    def stamp_ns(self) -> int:
        """Of the frame."""
        return self.frame.stamp_ns


class BootstrapMapper:
    """A mapper that waits for its calibration, with the interface of ``Mapper``.

    mapper: the trial, or the final one.    taken: during the trial, the newest frames.
    first: the first of them that the trial gave a pose.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        parameters: MappingParameters,
        seed: int,
        known: Sequence[KeptKeyframe] = (),
    ) -> None:
        """known: as of ``Mapper``; the trial ignores it."""
        self._anew = (camera, parameters, seed)
        self._known = list(known)
        self._mapper = Mapper(camera, parameters, seed)
        self._taken: list[_Taken] = []
        self._on_trial = True
        self._first: int | None = None

    def process(self, frame: Frame, timer: StageTimer = no_stages) -> MapDelta:
        """As ``Mapper.process``."""
        delta = self._mapper.process(frame, timer)
        if not self._on_trial:
            return delta
        taken = _Taken(frame)
        kept = keep_newest(self._taken, taken, self._anew[1].start)
        uncertain = float(self._mapper.calibration.sigmas[0])
        if delta.state == TRACKING:
            if self._first is None:
                self._first = int(delta.pose_frames.min())
            if uncertain < _KNOWN or kept[0].frame.number > self._first:
                self._taken.append(taken)
                return self._begin(timer)
        self._taken = kept
        reason = delta.reason or f"the focal length is known to {100.0 * uncertain:.1f} %"
        return _nothing(delta, reason)

    def only_localise(self, frame: Frame, otherwise: str) -> MapDelta:
        """As ``Mapper.only_localise``; a trial continues until the next mapped frame."""
        delta = self._mapper.only_localise(frame, otherwise)
        if not self._on_trial:
            return delta
        self._taken.append(_Taken(frame, is_mapped=False))
        return _nothing(delta, otherwise)

    def skip(self, frame: int, reason: str = "the frame has no pixels") -> MapDelta:
        """As ``Mapper.skip``."""
        delta = self._mapper.skip(frame, reason)
        return _nothing(delta, reason) if self._on_trial else delta

    @property
    def waiting_frames(self) -> list[int]:
        """As ``Mapper.waiting_frames``."""
        if self._on_trial:
            return [taken.frame.number for taken in self._taken]
        return self._mapper.waiting_frames

    @property
    def global_adjustment(self) -> GlobalAdjustment:
        """As ``Mapper.global_adjustment``."""
        return self._mapper.global_adjustment

    @property
    def point_count(self) -> int:
        """As ``Mapper.point_count``."""
        return 0 if self._on_trial else self._mapper.point_count

    @property
    def counters(self) -> dict[str, int]:
        """As ``Mapper.counters``."""
        return {} if self._on_trial else self._mapper.counters

    def finish(self, timer: StageTimer = no_stages) -> MapDelta:
        """As ``Mapper.finish``; a trial still running ends first."""
        begins = self._on_trial and (self._first is not None or self._mapper.start_at_last())
        begun = self._begin(no_stages) if begins else None
        final = self._mapper.finish(timer)
        return final if begun is None else _joined([begun, final])

    def kept(self) -> Iterator[KeptKeyframe]:
        """As ``Mapper.kept``; the loaded map if the trial found none."""
        return iter(self._known) if self._on_trial else self._mapper.kept()

    def publish_keyframes(self) -> KeyframeDelta:
        """As ``Mapper.publish_keyframes``."""
        if self._on_trial:
            return Mapper(*self._anew).publish_keyframes()
        return self._mapper.publish_keyframes()

    def _begin(self, timer: StageTimer) -> MapDelta:
        """Map all waiting frames with the camera that the trial has estimated."""
        self._mapper = Mapper(*self._anew, calibration=self._mapper.calibration, known=self._known)
        self._on_trial = False
        deltas: list[MapDelta] = []
        for taken in self._taken:
            deltas.append(self._again(taken, timer))
            self._mapper.atlas.stay()
        self._taken = []
        return _joined(deltas)

    def _again(self, taken: _Taken, timer: StageTimer) -> MapDelta:
        if taken.is_mapped:
            return self._mapper.process(taken.frame, timer)
        return self._mapper.only_localise(taken.frame, "")


def mapper_for(
    camera: PinholeCamera,
    parameters: MappingParameters,
    seed: int,
    focal_sigma: float = 0.0,
    known: Sequence[KeptKeyframe] = (),
) -> Mapper | BootstrapMapper | Localiser:
    """Return the mapper for a camera, depending on how certain its calibration is: see ``widened``.

    known: a loaded map; if it is of the same camera, its calibration is used.
    """
    parameters = widened(parameters, focal_sigma)
    if parameters.only_localise:
        return Localiser(camera, parameters, seed, known=known)
    found = known_camera(known, camera)
    if is_guess(parameters.calibration) and (found is None or found.sigmas[0] > _KNOWN):
        return BootstrapMapper(camera, parameters, seed, known)
    return Mapper(camera, parameters, seed, known=known)


_ARRAYS = [field.name for field in dataclasses.fields(MapDelta) if "Annotated" in str(field.type)]
_KEYS = {"pose": "pose_frames", "keyframe": "keyframe_ids", "point": "point_ids"}
"""Key fields of the row arrays, by the prefix of their names."""


def _nothing(delta: MapDelta, reason: str) -> MapDelta:
    """The update of a frame on trial."""
    empty: dict[str, Any] = {name: getattr(delta, name)[:0] for name in _ARRAYS}
    return dataclasses.replace(
        delta, state=WAITING, reason=reason, segment=-1, inliers=0, snapshot=False,
        calibration_correction=(), calibration_sigmas=(), **empty,
    )  # fmt: skip


def _joined(deltas: list[MapDelta]) -> MapDelta:
    """Combine the changes of a map's first frames; of repeated changes the last counts.

    Landmarks that were removed before publication are left out.
    """
    removed = np.concatenate([delta.removed_point_ids for delta in deltas])
    joined: dict[str, Any] = {"removed_point_ids": removed[:0]}
    for kind, key in _KEYS.items():
        ids = np.concatenate([getattr(delta, key) for delta in deltas])
        _, last = np.unique(ids[::-1], return_index=True)
        rows = np.sort(len(ids) - 1 - last)
        if kind == "point":
            rows = rows[~np.isin(ids[rows], removed)]
        for name in _ARRAYS:
            if name.startswith((f"{kind}_", f"{kind}s_")):
                joined[name] = np.concatenate([getattr(delta, name) for delta in deltas])[rows]
    return dataclasses.replace(deltas[-1], **joined)
