"""The current surfels, as columns."""

from dataclasses import dataclass, field, replace

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, BoolArray
from pliant.algorithms.geometry import transform
from pliant.algorithms.surfels.births import Births, join, select
from pliant.algorithms.surfels.brightness import brightness
from pliant.algorithms.surfels.deformation_graph import (
    Edges,
    find_edges,
    join_edges,
    keep_rows,
    median_strains,
    no_edges,
    share_of_neighbours,
)
from pliant.algorithms.surfels.deformation_models import move_poses
from pliant.algorithms.surfels.patch_sampling import BIAS, GAIN, POSE_FLOATS, A, B, F, X
from pliant.algorithms.surfels.surfel_alignment import Templates
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.algorithms.surfels.validation import (
    FRONT,
    INSIDE,
    SIGMA,
    VISIBLE,
    ZNCC,
    U,
    V,
    new_validations,
)

_EVEN_STRAIN, _STEEPNESS = 0.15, 1.2
"""Half of the surfels with this median strain are within 1 % of their depth; fitted on the rendered
scenes of ``scripts/bench surfels``."""
_ALONE = 0.5
"""Share of the confidence that stays where a surfel has lost all of its neighbours; with half of
them it has all."""
_IN_VIEW = 0.5
"""Share of a patch inside of the image."""
_EVEN_DISTORTION, _DISTORTION_STEEPNESS = 0.7, 2.0
"""The same for the distortion, within 3 px in the image; fitted on half of eight videos of tissue,
tested on the others."""
_DISTORTED = 0.5
"""Distortion beyond which no surfel is confirmed: of those at it, half are wrong."""


def _none() -> list[Templates]:
    return []


@dataclass
class SurfelTable:
    """N surfels, ordered by id.  Poses are in the world frame."""

    templates: list[Templates] = field(default_factory=_none)  # in use, one for each level
    birth: list[Templates] = field(default_factory=_none)  # the same at birth
    renewed: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))  # not that of birth
    birth_zncc: F64 = field(default_factory=lambda: np.zeros(0))  # with the birth template
    # Whether the depth map of the frame shows another depth.
    contradicted: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))
    # ``patch_distortions`` on made-up depth, else 0.
    distortions: F64 = field(default_factory=lambda: np.zeros(0))
    poses: F64 = field(default_factory=lambda: np.zeros((0, POSE_FLOATS)))  # last good ones
    rest: F64 = field(default_factory=lambda: np.zeros((0, 3)))  # X^0 of Eq. 20, world
    sigmas: F64 = field(default_factory=lambda: np.zeros(0))  # root of its Sigma, metres
    settled: bool = False  # whether surfels rest where a map has them
    # At birth, at the exposure of the first frame: see ``brightness``.
    brightness: F64 = field(default_factory=lambda: np.zeros(0))
    ids: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    state: U8 = field(default_factory=lambda: np.zeros(0, np.uint8))
    born: I32 = field(default_factory=lambda: np.zeros(0, np.int32))
    missing: F64 = field(default_factory=lambda: np.zeros(0))  # seconds since last good
    validations: F64 = field(default_factory=lambda: new_validations(0))
    guesses: F64 = field(default_factory=lambda: np.zeros((0, POSE_FLOATS)))  # where to look next
    tried: F64 = field(default_factory=lambda: np.zeros((0, 3)))  # what was judged last
    edges: Edges = field(default_factory=no_edges)

    def __len__(self) -> int:
        return len(self.ids)

    def add(
        self, births: Births, T_world_camera: F64, first_id: int, frame: int, sigmas: F64,
        exposure: float = 1.0,
    ) -> None:  # fmt: skip
        """Append new surfels, with ids from ``first_id`` on.

        exposure: of their frame, relative to the first.
        """
        n = len(births.poses)
        poses = move_poses(births.poses, T_world_camera)
        validations = new_validations(n)
        validations[:, [FRONT, INSIDE, VISIBLE, ZNCC]] = 1.0
        nothing = [select(each, np.zeros(0, np.int64)) for each in births.templates]
        for name in ("templates", "birth"):
            before = getattr(self, name) or nothing
            pairs = zip(before, births.templates, strict=True)
            setattr(self, name, [join(a, b) for a, b in pairs])
        self.renewed = np.concatenate([self.renewed, np.zeros(n, np.bool_)])
        self.birth_zncc = np.concatenate([self.birth_zncc, np.ones(n)])
        self.contradicted = np.concatenate([self.contradicted, np.zeros(n, np.bool_)])
        self.distortions = np.concatenate([self.distortions, np.zeros(n)])
        self.poses = np.concatenate([self.poses, poses])
        self.guesses = np.concatenate([self.guesses, poses])
        self.tried = np.concatenate([self.tried, poses[:, X : X + 3]])
        self.rest = np.concatenate([self.rest, poses[:, X : X + 3]])
        self.sigmas = np.concatenate([self.sigmas, sigmas])
        self.brightness = np.concatenate([self.brightness, exposure * brightness(births.poses)])
        self.ids = np.concatenate([self.ids, np.arange(first_id, first_id + n)])
        self.state = np.concatenate([self.state, np.zeros(n, np.uint8)])
        self.born = np.concatenate([self.born, np.full(n, frame, np.int32)])
        self.missing = np.concatenate([self.missing, np.zeros(n)])
        self.validations = np.concatenate([self.validations, validations])

    def move(self, T: F64) -> None:
        """Move all surfels by T (4, 4), world."""
        self.poses, self.guesses = move_poses(self.poses, T), move_poses(self.guesses, T)
        self.tried, self.rest = transform(T, self.tried), transform(T, self.rest)

    def settle(self, rows: I64, rest: F64, sigmas: F64) -> None:
        """Change rest (R, 3) and sigmas (R,) of some rows to those of a map."""
        self.settled = True
        self.rest, self.sigmas = self.rest.copy(), self.sigmas.copy()
        self.rest[rows], self.sigmas[rows] = rest, sigmas

    def copy(self) -> "SurfelTable":
        """Return a copy that can be tracked into another frame."""
        return replace(self, poses=self.poses.copy(), validations=self.validations.copy())

    def keep(self, rows: I64) -> None:
        """Drop all but some rows."""
        self.edges = keep_rows(self.edges, rows, len(self))
        self.templates = [select(each, rows) for each in self.templates]
        self.birth = [select(each, rows) for each in self.birth]
        for name in (
            "renewed",
            "birth_zncc",
            "contradicted",
            "distortions",
            "poses",
            "rest",
            "sigmas",
            "brightness",
            "ids",
            "state",
            "born",
            "missing",
            "validations",
            "guesses",
            "tried",
        ):
            setattr(self, name, np.ascontiguousarray(getattr(self, name)[rows]))

    def connect(
        self, first_new: int, count: int, *, with_earlier: bool, widely: bool = False
    ) -> None:
        """Connect the rows from ``first_new`` on with their neighbours, earlier ones or not.

        widely: as in ``find_edges``.
        """
        known = self.tracked.astype(np.int64)
        if not with_earlier:
            known[:first_new] = 0
        new = find_edges(self.guesses, known, first_new, count, widely=widely)
        self.edges = join_edges(self.edges, new)

    @property
    def tracked(self) -> BoolArray:
        """(N,) whether a surfel was tracked in the last frame."""
        return self.state == SurfelState.TRACKED

    @property
    def confirmed(self) -> BoolArray:
        """(N,) tracked by the birth template, its patch distorted as its neighbours' are."""
        return self.tracked & ~self.renewed & ~(self.distortions > _DISTORTED)


def frame_of(
    table: SurfelTable, *, frame: int, segment: int, lost: bool, T_world_camera: F64,
    depth_is_known: bool = True,
) -> SurfelFrame:  # fmt: skip
    """Return the published state of the surfels in a frame.

    depth_is_known: whether surfels begin with a depth that was measured.
    """
    ages = (frame - table.born).astype(np.int32)
    poses, validations = table.poses, table.validations
    f11, f12, f22 = (poses[:, F + k, None] for k in range(3))
    a, b = poses[:, A : A + 3], poses[:, B : B + 3]
    means = table.templates[0].means if table.templates else np.zeros(0)
    # Inside, grey levels have lost the template's mean; outside they are those of Eq. 5.
    biases = poses[:, BIAS] + means * (1.0 - poses[:, GAIN])
    return SurfelFrame(
        frame=frame,
        segment=segment,
        lost=lost,
        T_world_camera=T_world_camera.copy(),
        ids=table.ids.copy(),
        positions=poses[:, X : X + 3].copy(),
        tangents=np.stack([f11 * a + f12 * b, f12 * a + f22 * b], axis=2),
        deformations=poses[:, F : F + 3].copy(),
        points_px=_f32(validations[:, U : V + 1]),
        zncc=_f32(validations[:, ZNCC]),
        visible=_f32(validations[:, VISIBLE]),
        sigma=_f32(validations[:, SIGMA]),
        gains=_f32(poses[:, GAIN]),
        biases=_f32(biases),
        state=table.state.copy(),
        age=ages,
        born=table.born.copy(),
        tried=table.tried.copy(),
        birth_zncc=_f32(table.birth_zncc),
        confirmed=table.confirmed.astype(np.uint8),
        confidence=_f32(_confidence(table, depth_is_known=depth_is_known)),
    )


def _confidence(table: SurfelTable, *, depth_is_known: bool) -> F64:
    """(N,) probability that a position is right: within 1 % of its depth, or on made-up depth in
    its place in the image.

    The neighbours decide.  An error of depth changes hardly any pixel, but strains the edges.  On
    made-up depth a surfel that slides in the image is distorted otherwise than they are.  An error
    that all of them share shows in neither.  Only surfels that are both tracked are compared: the
    others have old positions.  Without such edges the ZNCC with the birth template remains, and
    half of it where a surfel is not tracked.  Few that are left of many neighbours may have been
    led astray by what took the others.  A measured depth overrules all of them.
    """
    if depth_is_known:
        off = median_strains(table.poses, table.edges, table.tracked) / _EVEN_STRAIN
        agreement = 1.0 / (1.0 + off**_STEEPNESS)
        in_view = table.tracked | (table.validations[:, INSIDE] >= _IN_VIEW)
        left = share_of_neighbours(table.edges, table.tracked, in_view)
        trust = np.where(table.tracked, np.minimum(1.0, _ALONE + left), 1.0)
    else:
        off = np.where(table.tracked, table.distortions, np.nan) / _EVEN_DISTORTION
        agreement, trust = 1.0 / (1.0 + off**_DISTORTION_STEEPNESS), 1.0
    likeness = np.clip(table.birth_zncc, 0.0, 1.0) * np.where(table.tracked, 1.0, 0.5)
    found = trust * np.where(np.isnan(agreement), likeness, agreement)
    return np.where(table.contradicted, 0.0, found)


def _f32(values: F64) -> F32:
    return np.ascontiguousarray(values, np.float32)
