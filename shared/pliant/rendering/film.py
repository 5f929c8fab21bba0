"""How a sequence is filmed, and what a frame of it holds.

Apart from the renderer: a sequence that was rendered before needs none of its kernels.
"""

from dataclasses import dataclass

from pydantic import Field

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.parameters import Parameters
from pliant.rendering.lens import NO_DISTORTION, Distortion


class CameraOptions(Parameters):
    """The camera that films a sequence."""

    width: int = Field(default=640, ge=32, le=4096, description="Columns of the image.")
    height: int = Field(default=480, ge=32, le=4096, description="Rows of the image.")
    focal: float = Field(default=525.0, gt=0.0, description="Focal length at 640 columns, pixels.")
    fps: float = Field(default=30.0, gt=0.0, description="Frames per second.")
    noise: float = Field(
        default=2.0, ge=0.0, description="Deviation of the image noise, grey values."
    )
    exposure: float = Field(
        default=0.2, ge=0.0, lt=1.0, description="Swing of the exposure: 0.2 is 20 %."
    )
    blur: float = Field(
        default=0.3, ge=0.0, le=1.0, description="Open shutter, share of the frame time."
    )
    distortion: Distortion = Field(default=NO_DISTORTION, description="k1, k2, p1, p2 of the lens.")
    colour: bool = Field(default=False, description="Colour images instead of grey ones.")
    seed: int = Field(default=0, ge=0, description="Seed of the noise.")

    def pinhole(self) -> PinholeCamera:
        """The camera of the rectified image."""
        focal = self.focal * self.width / 640.0
        return PinholeCamera(
            width=self.width,
            height=self.height,
            fx=focal,
            fy=focal,
            cx=0.5 * (self.width - 1),
            cy=0.5 * (self.height - 1),
        )


class FilmOptions(Parameters):
    """Options after the name of every built-in sequence."""

    frames: int | None = Field(
        default=None, ge=2, description="First frames only; all where not given."
    )
    width: int | None = Field(
        default=None, ge=64, le=2048, description="Columns; 3/4 as many rows."
    )
    noise: float = Field(default=2.0, ge=0.0, le=50.0, description="Image noise, grey values.")
    exposure: float = Field(
        default=0.2, ge=0.0, lt=1.0, description="Swing of the exposure; 0.2: 20 %."
    )
    blur: float = Field(
        default=0.3, ge=0.0, le=1.0, description="Open shutter, share of the frame time."
    )
    seed: int = Field(default=0, ge=0, description="Seed of the noise.")

    def camera(self, width: int = 640) -> CameraOptions:
        """The camera that films so; width: where none was given."""
        width = self.width or width
        return CameraOptions(
            width=width,
            height=3 * width // 4,
            noise=self.noise,
            exposure=self.exposure,
            blur=self.blur,
            seed=self.seed,
        )


@dataclass(frozen=True)
class RenderedFrame:
    """One frame and ground truth about it."""

    time_s: float
    T_world_camera: F64  # (4, 4), at the middle of the exposure
    image: U8  # (H, W) grey or (H, W, 3) red, green, blue
    depth_m: F64  # (H, W) z of the surface at the pixel centre of the rectified image, 0: none
