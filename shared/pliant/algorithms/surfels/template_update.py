"""The two templates of each surfel after a frame: confirm, search, renew (see second_templates)."""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, BoolArray
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.surfels import validation
from pliant.algorithms.surfels.deformation_graph import edge_rows, patch_distortions, torn_off
from pliant.algorithms.surfels.deformation_models import move_poses
from pliant.algorithms.surfels.graph_alignment import relocate
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.patch_sampling import BIAS, GAIN, A, Level, X
from pliant.algorithms.surfels.second_templates import (
    birth_bias,
    carried_by_neighbours,
    renew,
    restore,
)
from pliant.algorithms.surfels.surfel_alignment import Matcher, align_all, no_equilibrium
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.algorithms.surfels.surfel_table import SurfelTable
from pliant.algorithms.surfels.validation import new_validations

RELOCATED_ZNCC = 0.9
"""Minimum ZNCC of a recovered surfel, higher than that of a tracked one: repeated attempts may
match by chance.
"""
_RENEWED_ZNCC, _RENEWED_VISIBLE = 0.93, 0.8
"""A template is renewed below this ZNCC, if at least this share of the patch is visible."""
_GUARD_ZNCC = 0.5
"""Minimum ZNCC of the birth template: a surfel below it is an outlier."""
_CONFIRMED_PATCH, _SEARCH_PATCH = 0.2, 0.3
"""Maximum motion by the birth template, as a share of the patch's side: from the tracked position,
and from the position that the neighbours predict.
"""
_SEARCH_LEVELS, _SEARCH_PERIOD = 2, 5
"""Number of finest levels of the search, and frames between two searches of a surfel."""


@dataclass(frozen=True)
class TemplateUpdate:
    """Updates the templates in use, and the surfels that are confirmed by their birth templates.

    matchers: of the birth templates, one for each level of the pyramid of the frame.
    """

    table: SurfelTable
    parameters: SurfelParameters
    pyramid: list[Level]
    matchers: list[Matcher]
    T_world_camera: F64

    def run(self, frame: int) -> None:
        """Confirm, search and renew.  frame: its number, which selects the surfels to search."""
        table = self.table
        T_camera_world = inverse(self.T_world_camera)
        poses = move_poses(table.poses, T_camera_world)
        poses[:, BIAS] = birth_bias(poses, table.templates[0].means)
        poses[:, BIAS] -= table.birth[0].means * (1.0 - poses[:, GAIN])
        self._align_birth_templates(poses)
        self._compare_distortions(T_camera_world)
        self._search(frame, poses, T_camera_world)
        self._renew(T_camera_world)
        self._compare_distortions(T_camera_world)

    def _align_birth_templates(self, poses: F64) -> None:
        """Measure the birth templates at the tracked positions, and align them from there."""
        table, p, fine = self.table, self.parameters, self.matchers[0]
        found = new_validations(len(table))
        renewed = table.tracked & table.renewed
        rows = renewed.astype(np.uint8)
        table.birth_zncc = table.validations[:, validation.ZNCC].copy()
        table.birth_zncc[table.renewed] = 0.0
        validation.validate_all(poses, rows, fine, found)
        table.birth_zncc[renewed] = found[renewed, validation.ZNCC]
        before = found[:, [validation.U, validation.V]]
        relocate(poses, rows, table.edges, fine, p.strain)
        validation.validate_all(poses, rows, fine, found)
        self._confirm(renewed, poses, found, before, p.min_zncc, _CONFIRMED_PATCH * p.patch_px)
        guarded = table.tracked & table.renewed & (table.birth_zncc < _GUARD_ZNCC)
        table.state[guarded] = SurfelState.OUTLIER

    def _compare_distortions(self, T_camera_world: F64) -> None:
        """On made-up depth, which strains of edges do not judge."""
        table = self.table
        if self.parameters.depth_from == "flat":
            poses = move_poses(table.poses, T_camera_world)
            table.distortions = patch_distortions(poses, table.edges, table.tracked)

    def _search(self, frame: int, poses: F64, T_camera_world: F64) -> None:
        """Search a share of the unconfirmed surfels, so that every frame costs the same.

        Alone a surfel finds its pixel, but may drift along its ray.  So one that has torn itself
        off its neighbours is refused, as in tracking.
        """
        table, p = self.table, self.parameters
        due = ~table.confirmed & (table.ids % _SEARCH_PERIOD == frame % _SEARCH_PERIOD)
        rows, points, nearest = carried_by_neighbours(
            due, table.confirmed, table.born, table.rest, table.poses[:, X : X + 3]
        )
        if not len(rows):
            return
        found, searched = new_validations(len(table)), np.zeros(len(table), np.uint8)
        poses[rows, X : X + 3] = transform(T_camera_world, points)
        if p.depth_from == "flat":  # all began alike, and its own may be that of a wrong place
            poses[rows, A:GAIN] = move_poses(table.poses[nearest], T_camera_world)[:, A:GAIN]
        searched[rows] = 1
        validation.validate_all(poses, searched, self.matchers[0], found)
        before = found[:, [validation.U, validation.V]]
        for matcher in reversed(self.matchers[:_SEARCH_LEVELS]):
            align_all(poses, searched, no_equilibrium(len(table)), matcher)
        validation.validate_all(poses, searched, self.matchers[0], found)
        moved = move_poses(table.poses, T_camera_world)
        moved[rows] = poses[rows]
        torn = torn_off(table.edges, edge_rows(moved, table.edges)[0], len(table))
        least, most_px = max(p.min_zncc, RELOCATED_ZNCC), _SEARCH_PATCH * p.patch_px
        self._confirm((searched > 0) & ~torn, poses, found, before, least, most_px)

    def _confirm(
        self, wanted: BoolArray, poses: F64, found: F64, before: F64, least: float, most_px: float
    ) -> None:
        """Use the birth templates again where they fit within a distance of ``before``."""
        table, p = self.table, self.parameters
        step = np.linalg.norm(found[:, [validation.U, validation.V]] - before, axis=1)
        good = wanted & (found[:, validation.ZNCC] >= least) & (step <= most_px)
        good &= (found[:, validation.VISIBLE] >= p.min_visible) & np.isfinite(poses).all(axis=1)
        good &= (found[:, validation.INSIDE] >= p.min_visible) & (found[:, validation.FRONT] > 0.0)
        rows = np.flatnonzero(good)
        restore(rows, table.birth, table.templates)
        table.renewed[rows], table.missing[rows] = False, 0.0
        table.state[rows], table.validations[rows] = SurfelState.TRACKED, found[rows]
        table.birth_zncc[rows] = found[rows, validation.ZNCC]
        table.poses[rows] = move_poses(poses[rows], self.T_world_camera)
        table.guesses[rows] = table.poses[rows]
        table.tried[rows] = table.poses[rows, X : X + 3]

    def _renew(self, T_camera_world: F64) -> None:
        """Make new templates of tracked surfels whose ZNCC has fallen."""
        table, found = self.table, self.table.validations
        rows = np.flatnonzero(
            table.tracked
            & (found[:, validation.ZNCC] < _RENEWED_ZNCC)
            & (found[:, validation.VISIBLE] >= _RENEWED_VISIBLE)
            & (found[:, validation.INSIDE] >= 1.0)
        )
        poses = move_poses(table.poses, T_camera_world)
        renew(poses, rows, self.pyramid, self.parameters.highlight, table.birth, table.templates)
        table.poses[rows, BIAS] = table.guesses[rows, BIAS] = poses[rows, BIAS]
        table.renewed[rows] = True
