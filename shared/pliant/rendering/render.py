"""Renders the frames of a sequence: image, exact depth, surface and pose."""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8
from pliant.algorithms.geometry import so3_exp
from pliant.rendering.colours import colour_image
from pliant.rendering.face_textures import (
    FaceColours,
    FaceTexture,
    pack_atlas,
    pack_colours,
)
from pliant.rendering.film import CameraOptions, RenderedFrame
from pliant.rendering.lens import NO_DISTORTION, pixel_rays
from pliant.rendering.paths import CameraPath
from pliant.rendering.photometry import exposure_gain, sensor_image
from pliant.rendering.raycast import Atlas, accumulate, cast, cast_depth
from pliant.rendering.solids import Scene, SolidArrays, face_sizes, solid_arrays
from pliant.rendering.visible_tiles import Tiles, View, tile_bounds, view_of, visible_tiles

# Offsets of the sub-exposures within a pixel, in sixths: no two share a row or a column.
SUB_PIXELS = ((-2.5, 0.5), (1.5, 2.5), (-0.5, -1.5), (2.5, -0.5), (-1.5, 1.5), (0.5, -2.5))
# A little sharper than by the footprint: the sub-pixel offsets take care of the rest.
FOOTPRINT = 0.7


@dataclass(frozen=True)
class Surface:
    """Depths and surfaces at the pixel centres of an image."""

    depth_m: F64  # (H, W), 0 where nothing is seen
    faces: I32  # (H, W) number of the face, -1 where nothing is seen
    normals: F64  # (H, W, 3) unit normals towards the camera, world frame


class SceneGeometry:
    """A scene's solids, ready for rays."""

    def __init__(self, scene: Scene) -> None:
        rotations = so3_exp(np.array([solid.rotation for solid in scene.solids], np.float64))
        self.scene = scene
        self.solids: SolidArrays = solid_arrays(scene, rotations)

    @property
    def n_faces(self) -> int:
        """Number of faces of all solids together."""
        return len(face_sizes(self.scene))

    def look(self, T_world_camera: F64, bounds: F64, margin: float) -> tuple[View, Tiles]:
        """The view from a pose and what its tiles may show."""
        view = view_of(self.solids, T_world_camera)
        return view, visible_tiles(self.solids, view, bounds, margin)

    def depth(self, T_world_camera: F64, rays: F64, bounds: F64 | None = None) -> F64:
        """(H, W) exact depth on (H, W, 2) rays of the plane z = 1, metres; 0: nothing there.

        bounds: those of the rays' tiles, where they are known already.
        """
        depth = np.zeros(rays.shape[:2])
        bounds = tile_bounds(rays) if bounds is None else bounds
        view, tiles = self.look(T_world_camera, bounds, 1e-6)
        cast_depth(rays, self.solids, view, tiles, depth)
        return depth

    def surface(self, T_world_camera: F64, rays: F64) -> Surface:
        """Meet (H, W, 2) rays of the plane z = 1 with the scene."""
        shape = rays.shape[:2]
        depth, faces = np.zeros(shape), np.zeros(shape, np.int32)
        normals = np.zeros((*shape, 3))
        view, tiles = self.look(T_world_camera, tile_bounds(rays), 1e-6)
        cast(rays, self.solids, view, tiles, depth, faces, normals)
        return Surface(depth, faces, normals)


class Renderer:
    """Films one scene along one path.  Frames are independent of each other and of their order."""

    def __init__(
        self,
        geometry: SceneGeometry,
        textures: list[FaceTexture],
        path: CameraPath,
        camera: CameraOptions,
        colours: list[FaceColours] | None = None,
    ) -> None:
        """textures: one for each face of the scene, from ``make_face``.

        colours: likewise, from ``make_face_colours``; without them images are grey.
        """
        self._geometry = geometry
        self._atlas: Atlas = pack_atlas(textures)
        self._path = path
        self._options = camera
        self._camera = camera.pinhole()
        self._colours = pack_colours(colours or [])
        self._channels = 1 if colours is None else 3
        self._rays = [
            pixel_rays(self._camera, camera.distortion, (x / 6.0, y / 6.0)).astype(np.float32)
            for x, y in SUB_PIXELS
        ]
        self._bounds = [tile_bounds(rays) for rays in self._rays]
        self._rectified_rays = pixel_rays(self._camera, NO_DISTORTION)
        self._rectified_bounds = tile_bounds(self._rectified_rays)

    def frame(self, number: int, time_s: float) -> RenderedFrame:
        """Film the frame whose exposure has its middle at ``time_s``."""
        options = self._options
        T_world_camera = self._path.T_world_camera(time_s)
        light = self._expose(time_s)
        rng = np.random.default_rng([options.seed, number])
        gain = exposure_gain(time_s, options.exposure)
        grey = sensor_image(light[:, :, :1], gain=gain, noise=options.noise, rng=rng)[:, :, 0]
        return RenderedFrame(
            time_s=time_s,
            T_world_camera=T_world_camera,
            image=np.ascontiguousarray(grey) if self._channels == 1 else _coloured(grey, light),
            depth_m=self._geometry.depth(
                T_world_camera, self._rectified_rays, self._rectified_bounds
            ),
        )

    def _expose(self, time_s: float) -> F32:
        """(H, W, C) as of ``accumulate``, mean of the sub-exposures while the shutter is open."""
        camera, n = self._camera, len(SUB_PIXELS)
        light = np.zeros((camera.height, camera.width, self._channels), np.float32)
        for i, (rays, bounds) in enumerate(zip(self._rays, self._bounds, strict=True)):
            # Sub-exposures lie evenly about the middle, so that the blur does not shift the image.
            delay = ((i + 0.5) / n - 0.5) * self._options.blur / self._options.fps
            view, tiles = self._geometry.look(
                self._path.T_world_camera(time_s + delay), bounds, 1.0 / camera.fx
            )
            accumulate(
                rays,
                self._geometry.solids,
                view,
                tiles,
                self._atlas,
                self._colours,
                FOOTPRINT / camera.fx,
                1.0 / n,
                light,
            )
        return light


def _coloured(grey: U8, light: F32) -> U8:
    """(H, W, 3) RGB of which (H, W) is the grey image; light: (H, W, 3) as of ``accumulate``."""
    whole = np.maximum(light[:, :, 0], np.float32(1e-6))
    return colour_image(grey, light[:, :, 1] / whole, light[:, :, 2] / whole)
