"""Camera paths as functions of time: smooth ones from control points, and given trajectories."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import inverse, pose_to_matrix, so3_exp, so3_log


class CameraPath(Protocol):
    """A camera pose for every time within ``duration_s``."""

    @property
    def duration_s(self) -> float:
        """Length of the path, seconds."""
        ...

    def T_world_camera(self, time_s: float) -> F64:
        """(4, 4) pose at a time; times outside are clamped to the ends."""
        ...


def look_at(position: F64, target: F64, *, up: F64) -> F64:
    """(4, 4) pose of a camera at ``position`` whose axis meets ``target``, image upright."""
    forward = target - position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2] = right, np.cross(forward, right), forward
    T[:3, 3] = position
    return T


@dataclass(frozen=True)
class SplinePath:
    """A hand-held camera that flies along one cubic B-spline and looks at points of another.

    The control points are equally spaced in time; the path is twice continuously differentiable.
    A slow tremble (sines of unrelated frequencies) is added to position and direction.
    """

    positions: Sequence[tuple[float, float, float]]
    targets: Sequence[tuple[float, float, float]]
    duration_s: float
    tremble_m: float = 0.003
    tremble_rad: float = 0.005
    up: F64 = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    lead_s: float = (
        0.0  # on its way so long before time 0: what opens a little earlier sees it move
    )

    def T_world_camera(self, time_s: float) -> F64:
        """(4, 4) pose at a time; times outside are clamped to the ends."""
        part = (time_s + self.lead_s) / (self.duration_s + self.lead_s)
        part = min(max(part, 0.0), 1.0)
        position = _bspline(np.array(self.positions, np.float64), part)
        target = _bspline(np.array(self.targets, np.float64), part)
        T = look_at(position, target, up=self.up)
        T[:3, 3] += self.tremble_m * _tremble(time_s, 0.0)
        T[:3, :3] = T[:3, :3] @ so3_exp(self.tremble_rad * _tremble(time_s, 2.0))
        return T


@dataclass(frozen=True)
class SampledPath:
    """A given trajectory: (N,) times in seconds, ascending, and (N, 7) poses.

    Between two samples the camera turns about a fixed axis and moves along a straight line.
    """

    times_s: F64
    poses: F64

    @property
    def duration_s(self) -> float:
        """Length of the path, seconds."""
        return float(self.times_s[-1] - self.times_s[0])

    def T_world_camera(self, time_s: float) -> F64:
        """(4, 4) pose at a time after the first sample; times outside are clamped to the ends."""
        time = time_s + float(self.times_s[0])
        i = int(np.clip(np.searchsorted(self.times_s, time, side="right") - 1, 0, self._last - 1))
        before, after = pose_to_matrix(self.poses[i]), pose_to_matrix(self.poses[i + 1])
        step = float(self.times_s[i + 1] - self.times_s[i])
        part = float(np.clip((time - self.times_s[i]) / step, 0.0, 1.0))
        turn = so3_log((inverse(before) @ after)[None, :3, :3])[0]
        out = before.copy()
        out[:3, :3] = before[:3, :3] @ so3_exp(part * turn)
        out[:3, 3] = (1.0 - part) * before[:3, 3] + part * after[:3, 3]
        return out

    @property
    def _last(self) -> int:
        return len(self.times_s) - 1


@dataclass(frozen=True)
class TurnedPath:
    """A path that is halted for a full turn on the spot, and then continues.

    axis: (3,) unit vector in the camera, about which it turns.   at_s: time of the halt.
    The turn starts and ends slowly.
    """

    path: CameraPath
    axis: tuple[float, float, float]
    at_s: float
    turn_s: float

    @property
    def duration_s(self) -> float:
        """Length of the path, seconds."""
        return self.path.duration_s + self.turn_s

    def T_world_camera(self, time_s: float) -> F64:
        """(4, 4) pose at a time; times outside are clamped to the ends."""
        turning_s = min(max(time_s - self.at_s, 0.0), self.turn_s)
        part = turning_s / self.turn_s
        angle = 2.0 * np.pi * part * part * (3.0 - 2.0 * part)
        T = self.path.T_world_camera(time_s - turning_s).copy()
        T[:3, :3] = T[:3, :3] @ so3_exp(angle * np.array(self.axis))
        return T


def _bspline(points: F64, part: float) -> F64:
    """Uniform cubic B-spline through (N, 3) control points, ends held; part from 0 to 1."""
    padded = np.concatenate([points[:1], points[:1], points, points[-1:], points[-1:]])
    # The outermost span on either side hardly moves: leave it out.
    s = 1.0 + part * (len(padded) - 5)
    i = min(int(s), len(padded) - 4)
    t = s - i
    weights = np.array(
        [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]
    )
    return weights @ padded[i : i + 4] / 6.0


def _tremble(time_s: float, phase: float) -> F64:
    frequencies_hz = np.array([[0.53, 0.71, 0.61], [1.13, 0.97, 1.29], [2.27, 2.03, 2.41]])
    strength = np.array([[1.0], [0.5], [0.15]])
    start = phase + np.array([[0.3, 1.7, 2.9], [4.1, 5.3, 0.9], [2.2, 3.4, 1.1]])
    return (strength * np.sin(2.0 * np.pi * frequencies_hz * time_s + start)).sum(axis=0)
