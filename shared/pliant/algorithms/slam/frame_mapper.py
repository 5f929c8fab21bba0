"""The interface of the three classes that map or localise the frames of a source."""

from collections.abc import Iterable
from typing import Protocol

from pliant.algorithms.inertial.samples import ImuSamples
from pliant.algorithms.map_delta import KeyframeDelta, MapDelta
from pliant.algorithms.slam.adjust.global_adjustment import GlobalAdjustment
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.algorithms.stages import StageTimer, no_stages


class FrameMapper(Protocol):
    """``Mapper``, ``BootstrapMapper`` of an unknown camera, or ``Localiser`` in a loaded map.

    Every frame goes to one of ``process``, ``only_localise`` and ``skip``, in their order.  The
    object is its state: a checkpoint stores it.
    """

    def add_samples(self, samples: ImuSamples) -> None:
        """Take in the next inertial samples of the source, if it has any, before the frame that
        they precede.
        """
        ...

    def process(self, frame: Frame, timer: StageTimer = no_stages) -> MapDelta:
        """Localise a frame, extend the map, and return what readers need."""
        ...

    def only_localise(self, frame: Frame, otherwise: str) -> MapDelta:
        """Localise a frame by its tracks, when there is no time to map it.

        otherwise: the reason that a frame without a pose is published with.
        """
        ...

    def skip(self, frame: int, reason: str = ...) -> MapDelta:
        """Skip a frame without pixels or without time: it gets no pose."""
        ...

    def finish(self, timer: StageTimer = no_stages) -> MapDelta:
        """Return the last corrections, after the last frame."""
        ...

    def publish_keyframes(self) -> KeyframeDelta:
        """Return the keyframe changes after a frame, or after ``finish``."""
        ...

    def kept(self) -> Iterable[KeptKeyframe]:
        """Return the map to be saved, after ``finish``; nothing if it is unchanged."""
        return ()

    @property
    def global_adjustment(self) -> GlobalAdjustment:
        """Global bundle adjustment: its job, for a thread, and where the result goes."""
        ...

    @property
    def waiting_frames(self) -> list[int]:
        """Numbers of the frames from which a map may still start."""
        return []

    @property
    def point_count(self) -> int:
        """Number of landmarks."""
        ...

    @property
    def counters(self) -> dict[str, float]:
        """Counts for the summary of a run."""
        return {}
