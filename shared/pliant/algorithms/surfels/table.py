"""The surfels that are being tracked, as columns."""

from dataclasses import dataclass, field

import numpy as np

from pliant.algorithms.arrays import F64, I32, I64, U8, BoolArray
from pliant.algorithms.surfels.align import Templates
from pliant.algorithms.surfels.birth import Births, join, select
from pliant.algorithms.surfels.judge import CORRELATION, FRONT, INSIDE, SEEN, new_verdicts
from pliant.algorithms.surfels.neighbours import (
    Edges,
    find_edges,
    join_edges,
    keep_rows,
    no_edges,
)
from pliant.algorithms.surfels.sampling import POSE_FLOATS, A, B, X
from pliant.algorithms.surfels.states import SurfelState


def _none() -> list[Templates]:
    return []


@dataclass
class SurfelTable:
    """N surfels, ordered by id.  Poses are in the world frame."""

    templates: list[Templates] = field(default_factory=_none)  # one for each level
    poses: F64 = field(default_factory=lambda: np.zeros((0, POSE_FLOATS)))  # last good ones
    rest: F64 = field(default_factory=lambda: np.zeros((0, 3)))  # X^0, or the equilibrium
    information: F64 = field(default_factory=lambda: np.zeros((0, 3, 3)))  # Sigma^-1, world, 1/m^2
    ids: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    state: U8 = field(default_factory=lambda: np.zeros(0, np.uint8))
    born: I32 = field(default_factory=lambda: np.zeros(0, np.int32))
    missing: I32 = field(default_factory=lambda: np.zeros(0, np.int32))  # frames since last good
    verdicts: F64 = field(default_factory=lambda: new_verdicts(0))
    guesses: F64 = field(default_factory=lambda: np.zeros((0, POSE_FLOATS)))  # where to look next
    tried: F64 = field(default_factory=lambda: np.zeros((0, 3)))  # what was judged last
    edges: Edges = field(default_factory=no_edges)

    def __len__(self) -> int:
        return len(self.ids)

    def add(
        self, births: Births, T_world_camera: F64, first_id: int, frame: int, information: F64
    ) -> None:
        """Append new surfels; theirs are the ids from ``first_id`` on."""
        n = len(births.poses)
        poses = move_poses(births.poses, T_world_camera)
        verdicts = new_verdicts(n)
        verdicts[:, [FRONT, INSIDE, SEEN, CORRELATION]] = 1.0
        self.templates = (
            [join(a, b) for a, b in zip(self.templates, births.templates, strict=True)]
            if self.templates
            else births.templates
        )
        self.poses = np.concatenate([self.poses, poses])
        self.guesses = np.concatenate([self.guesses, poses])
        self.tried = np.concatenate([self.tried, poses[:, X : X + 3]])
        self.rest = np.concatenate([self.rest, poses[:, X : X + 3]])
        self.information = np.concatenate([self.information, information])
        self.ids = np.concatenate([self.ids, np.arange(first_id, first_id + n)])
        self.state = np.concatenate([self.state, np.zeros(n, np.uint8)])
        self.born = np.concatenate([self.born, np.full(n, frame, np.int32)])
        self.missing = np.concatenate([self.missing, np.zeros(n, np.int32)])
        self.verdicts = np.concatenate([self.verdicts, verdicts])

    def keep(self, rows: I64) -> None:
        """Drop all but some rows."""
        self.edges = keep_rows(self.edges, rows, len(self))
        self.templates = [select(each, rows) for each in self.templates]
        for name in (
            "poses",
            "rest",
            "information",
            "ids",
            "state",
            "born",
            "missing",
            "verdicts",
            "guesses",
            "tried",
        ):
            setattr(self, name, np.ascontiguousarray(getattr(self, name)[rows]))

    def connect(self, first_new: int, count: int) -> None:
        """Give the rows from ``first_new`` on their neighbours."""
        known = self.tracked.astype(np.int64)
        new = find_edges(self.guesses, known, first_new, count)
        self.edges = join_edges(self.edges, new)

    @property
    def tracked(self) -> BoolArray:
        """(N,) whether a surfel was found in the last frame."""
        return self.state == SurfelState.TRACKED


def move_poses(poses: F64, T: F64) -> F64:
    """Surfels in another frame: (N, POSE_FLOATS) rows moved by a (4, 4) rigid motion."""
    out = poses.copy()
    R = T[:3, :3]
    out[:, X : X + 3] = poses[:, X : X + 3] @ R.T + T[:3, 3]
    out[:, A : A + 3] = poses[:, A : A + 3] @ R.T
    out[:, B : B + 3] = poses[:, B : B + 3] @ R.T
    return out
