"""How a camera turns between frames: by the gyro for the pose solver, by images for the gyro."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.inertial.gyro import Gyro
from pliant.algorithms.inertial.samples import ImuSamples, joined
from pliant.algorithms.slam.active.active_map import ActiveMap
from pliant.algorithms.slam.active.frame_pose import rotation_by_image
from pliant.algorithms.slam.frame import PlacedFrame
from pliant.algorithms.slam.locate.localisation import Motion


@dataclass(frozen=True, kw_only=True)
class ByImage:
    """R_world_camera (3, 3) of a frame by its image alone, and the variance of its error, rad^2."""

    stamp_ns: int
    R: F64
    variance: float


@dataclass
class FrameTurns:
    """The gyro of a source, if it has one.

    The gyro's rotation is a prior of a frame's pose, so that pose cannot judge the gyro.  What the
    image alone shows can.

    last: the image that was shown to the gyro last.   R_last: rotation of its pose at that time,
    so R_last^T last.R is the difference between pose and image, in whatever world.
    here: the image of the current frame, in the current world.
    """

    gyro: Gyro | None = None
    last: ByImage | None = None
    R_last: F64 = field(default_factory=lambda: np.eye(3))
    here: ByImage | None = None

    def add_samples(self, more: ImuSamples, so_far: Sequence[ImuSamples]) -> None:
        """Take in the next samples.   so_far: blocks of all, these included."""
        if self.gyro is None:
            self.gyro = Gyro.of(joined(so_far))
        else:
            self.gyro.add_samples(more)

    @property
    def counters(self) -> dict[str, int]:
        """Counts for the summary of a run."""
        return {} if self.gyro is None else self.gyro.counters

    def predict(self, motion: Motion, stamp_ns: int) -> Motion:
        """Return the motion with the gyro's turn from the last pose to a frame."""
        if self.gyro is None:
            return motion
        return replace(motion, turn=self.gyro.predict(motion.stamps_ns[1], stamp_ns))

    def look(self, active: ActiveMap, motion: Motion, placed: PlacedFrame) -> None:
        """Find what the image of a frame shows, before it changes the map.   motion: before it."""
        self.here = None
        if motion.turn is not None:
            R, variance = rotation_by_image(active, placed)
            self.here = ByImage(stamp_ns=placed.frame.stamp_ns, R=R, variance=variance)

    def follow(self, S: F64) -> None:
        """Move what the image of this frame shows with the world, by a similarity (4, 4)."""
        if self.here is not None:
            R = S[:3, :3] / np.cbrt(np.linalg.det(S[:3, :3]))
            self.here = replace(self.here, R=R @ self.here.R)

    def see(self, motion: Motion, placed: PlacedFrame) -> None:
        """Show the gyro how the camera has turned to a frame.   motion: before it."""
        gyro, stamp_ns, last = self.gyro, placed.frame.stamp_ns, self.last
        if gyro is None or gyro.is_over:
            return
        R, here = placed.T_world_camera[:3, :3].copy(), self.here
        if here is None:
            here = ByImage(stamp_ns=stamp_ns, R=R, variance=0.0)
        before_ns, before = motion.stamps_ns[1], motion.poses[1][:3, :3]
        if before_ns < stamp_ns:
            at_first = 0.0
            if last is not None and last.stamp_ns == before_ns:
                before, at_first = before @ self.R_last.T @ last.R, last.variance
            gyro.frames += motion.turn is not None
            gyro.see(before_ns, stamp_ns, before.T @ here.R, (at_first, here.variance))
        self.last, self.R_last, self.here = here, R, None
