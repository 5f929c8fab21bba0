"""The depth of a new keyframe in our own map: the initial depth of surfels without a sensor.

DSDT takes its first depth from a stereo pair or a sensor.  One camera alone has the map of bundle
adjustment, as long as the scene holds nearly still: what moves meanwhile has no certain depth.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.deformable.deforming_window import SIGMA
from pliant.algorithms.deformable.moving_landmarks import WindowMap
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.map_delta import TRACKING, KeyframeDelta, MapDelta
from pliant.algorithms.meshing.keyframe_surface import KeyframeSurfaces, SeenPoints
from pliant.algorithms.meshing.parameters import SurfaceParameters
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.map_history import CurrentMap


@dataclass(frozen=True)
class MapView:
    """The depth of a keyframe of our own map, in units and world of the map as it is then.

    depth: (H, W) along the optical axis, 0 where nothing is known.    segment: of the map.
    """

    depth: F64
    T_world_camera: F64  # (4, 4)
    segment: int


def view_of_window(found: WindowMap, camera: PinholeCamera, segment: int) -> MapView | None:
    """The depth of the newest keyframe of a window, None where its landmarks make no surface."""
    rows = found.in_view
    count = len(rows)
    points = SeenPoints(
        ids=found.ids[rows],
        points_px=found.points_px[rows],
        points_world=(found.rest + found.moved()[-1])[rows],
        sigmas=np.full(count, SIGMA / SurfaceParameters().noise_px, np.float32),
        keyframes=np.full(count, len(found.frames), np.int32),
    )
    T_world_camera = found.T_world_camera[-1]
    surface = KeyframeSurfaces(camera, SurfaceParameters()).surface(T_world_camera, points)
    if surface.depth_map is None:
        return None
    return MapView(surface.depth_map.depths.astype(np.float64), T_world_camera, segment)


class MapDepth:
    """Waits for keyframes that know enough depths.  A function of what it is given.

    problem: why the last frame is none, "" where it is one.
    """

    def __init__(self, camera: PinholeCamera, parameters: SurfelParameters) -> None:
        self._camera = camera
        self._parameters = parameters
        self._map = CurrentMap()
        self.problem = ""

    def take(
        self, update: MapDelta, keyframes: KeyframeDelta, frame: int, *, max_sigma: float
    ) -> MapView | None:
        """Take in what a frame changed in the map: the keyframe that it became, if it is such one.

        max_sigma: of a depth that counts as certain, as a share of it.
        """
        self._map.take(update, frame)
        if update.state != TRACKING:
            self.problem = update.reason or "there is none yet"
            return None
        of_segment = [k for k in self._map.keyframes.values() if k.segment == update.segment]
        if len(of_segment) < self._parameters.map_keyframes:
            self.problem = f"{len(of_segment)} keyframes so far"
            return None
        if keyframes.new < 0:
            return None
        points = self._certain(keyframes, max_sigma)
        if len(points.ids) < self._parameters.map_points:
            self.problem = (
                f"{len(points.ids)} points of certain depth, {self._parameters.map_points} needed: "
                "the camera must move, and the scene hold nearly still at first"
            )
            return None
        T_world_camera = pose_to_matrix(self._map.keyframes[keyframes.new].pose_world_camera)
        surfaces = KeyframeSurfaces(self._camera, SurfaceParameters())
        found = surfaces.surface(T_world_camera, points).depth_map
        if found is None:
            self.problem = "its points make no surface"
            return None
        self.problem = ""
        return MapView(found.depths.astype(np.float64), T_world_camera, update.segment)

    def _certain(self, keyframes: KeyframeDelta, max_sigma: float) -> SeenPoints:
        """The points of the new keyframe, without those whose depth is uncertain."""
        bounds = np.concatenate([[0], np.cumsum(keyframes.counts)])
        row = int(np.flatnonzero(keyframes.keyframe_ids == keyframes.new)[0])
        published = slice(int(bounds[row]), int(bounds[row + 1]))
        rows, points = self._map.points_of(keyframes.point_ids[published])
        sigmas = np.asarray(points.sigmas, np.float32)
        noise_px = SurfaceParameters().noise_px
        good = np.flatnonzero(sigmas * noise_px < max_sigma)
        return SeenPoints(
            ids=points.ids[good],
            points_px=keyframes.points_px[published][rows][good],
            points_world=points.positions[good],
            sigmas=sigmas[good],
            keyframes=np.asarray(points.keyframes, np.int32)[good],
        )
