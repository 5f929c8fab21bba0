"""A second look, at full size, for surfels that the image did not show where they were expected.

Surfels that hold together look at the image only where it already fits (``together``).  One that
the coarse scales left a pixel or two away, as fine texture does, would be carried by its neighbours
from frame to frame and never meet its image again.  So it is aligned alone once more, from where
its neighbours have carried it, and tied to that place as firmly as they hold it: Eq. 21 with that
place as the equilibrium.
"""

import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.surfels.align import Limits, Templates, Workspace, align_all
from pliant.algorithms.surfels.neighbours import Edges
from pliant.algorithms.surfels.rest import OMEGA_E, Rest
from pliant.algorithms.surfels.sampling import Level, X


def look_again(
    poses: F64, wanted: U8, edges: Edges, level: Level, templates: Templates, limits: Limits,
    work: Workspace, strain: float,
) -> None:  # fmt: skip
    """Align the wanted surfels alone at full size.

    poses: (N, POSE_FLOATS) in the camera's frame, those that are wanted are overwritten.  wanted:
    (N,) 1 or 0.  strain: of the pairs, relative.
    """
    rest = Rest(np.ascontiguousarray(poses[:, X : X + 3]), held_by(edges, len(poses), strain))
    align_all(poses, wanted, rest, level, templates, limits, work)


def held_by(edges: Edges, count: int, strain: float) -> F64:
    """(N, 3, 3) DN^2 / m^2 by which its pairs hold each of ``count`` surfels where it is."""
    pulls = np.repeat(OMEGA_E / (strain * edges.lengths) ** 2, 2)
    total = np.bincount(edges.ends.ravel(), weights=pulls, minlength=count)
    return np.ascontiguousarray(total[:, None, None] * np.eye(3))
