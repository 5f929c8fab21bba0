"""Every message.  Each is a frozen record; fields are added with a default, never renamed.

A message with the result of an algorithm *is* that result plus a header.  So a service sends the
result, and an algorithm takes a message, without copying fields.
"""

from dataclasses import dataclass, field, fields
from typing import Annotated, Any, TypeVar

from pliant.algorithms.arrays import F32, F64, I32, U8, Shape
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.deformable.moving_landmarks import WindowMap
from pliant.algorithms.inertial.samples import GpsFixes, ImuSamples
from pliant.algorithms.map_delta import KeyframeDelta, MapDelta
from pliant.algorithms.meshing.mesh_blocks import MeshBlocks, no_rows
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.algorithms.surfels.surfel_frame import SurfelFrame
from pliant.algorithms.tracks import FrameTracks

CAMERA_FRAME_ID = "camera"
IMU_FRAME_ID = "imu"
GPS_FRAME_ID = "earth"
DROPPED = "dropped"
"""Why an image is missing that live mode left out."""
BROKEN = "broken: "
"""How it begins why an image is missing that does not decode."""
MASKED = "masked: none of it is used"
"""Why an image is missing all of which a mask covers."""
PASSED_OVER = "passed over to keep up"
"""Why a frame that has pixels has no pose as it comes: it is not mapped, and no tracks place it."""
WAITING_FOR_DEPTH = "waiting for depth"
"""Why a frame has no surfels yet."""
CONTRADICTED = "the depth map contradicts the surfels"
"""Begin of the note of a frame whose measured depth is not that of most surfels."""
WORLD_FRAME_ID = "world"

_M = TypeVar("_M", bound="Header")


@dataclass(frozen=True, kw_only=True)
class Header:
    """frame: sequence number from 0.  stamp_ns: capture time.  frame_id: coordinate frame."""

    frame: int
    stamp_ns: int
    frame_id: str

    @classmethod
    def of(cls: type[_M], header: "Header", content: Any, **more: Any) -> _M:
        """This message with the time of ``header`` and what it has of ``content``, not copied."""
        own = {field.name for field in fields(Header)} - {"frame_id"}
        names = {field.name for field in fields(content)} & {field.name for field in fields(cls)}
        values = {name: getattr(content, name) for name in sorted(names - own)}
        values.update(more)
        return cls(
            frame=header.frame,
            stamp_ns=header.stamp_ns,
            frame_id=values.pop("frame_id", header.frame_id),
            **values,
        )


@dataclass(frozen=True, kw_only=True)
class CameraStream(Header):
    """Opens a stream: which camera it is, before and after rectification.

    source: name of the source.     mode: "lossless" or "live".
    frames: how many will come, -1 if unknown.
    calibration: the source's, as YAML, from which the rectified image can be made again.
    width, height, fx, fy, cx, cy: the rectified pinhole camera, in pixels.
    scale_is_metric: whether lengths are metres, as those of a map are whose scale was measured.
    z_is_up: whether the z axis of the map points against gravity, as inertial samples measured it.
    focal_sigma: standard deviation of the log focal length where it is a guess; 0: calibrated.
    source_width, source_height: of the images before they were made smaller; 0: as they are.
    sensors_last: whether what other sensors measured comes with the frames or after the last one,
    not before the first.   imu_by_frame: whether a piece of inertial samples precedes each frame.
    """

    source: str
    mode: str
    frames: int
    calibration: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    scale_is_metric: bool = False
    focal_sigma: float = 0.0
    source_width: int = 0
    source_height: int = 0
    z_is_up: bool = False
    sensors_last: bool = False
    imu_by_frame: bool = False

    @property
    def camera(self) -> PinholeCamera:
        """The rectified camera."""
        return PinholeCamera(
            width=self.width, height=self.height, fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy
        )


@dataclass(frozen=True)
class Rows:
    """Marks a field of bytes as rows; another field has their number (0: none)."""

    field: str


@dataclass(frozen=True, kw_only=True)
class SourceImage(Header):
    """A frame as it came: ``encoding`` is that of ``data``.  Empty where it was dropped.

    made_from: "" as it came; else what it was before it was made smaller, or a JPEG for a link.
    unmapped, unplaced: as in ``Image``, so that a replay does what the run did.
    clip_frame: which frame of ``camera/clip`` it is made from; -1: of none.
    checksum: of a recording that holds the clip instead of ``data``, which is empty then: CRC-32 of
    these.  ``pliant.datasets.recorded_images`` makes them again.
    mask: which part of it is used, an image file of its own, of any size; b"": all of it.
    source_frame: its number in the source, where only a part of that is taken; -1: ``frame``.
    """

    encoding: str
    width: int
    height: int
    data: Annotated[bytes, Rows("height")]
    made_from: str = ""
    unmapped: bool = False
    clip_frame: int = -1
    checksum: int = 0
    mask: bytes = b""
    source_frame: int = -1
    unplaced: bool = False


@dataclass(frozen=True, kw_only=True)
class ClipPiece(Header):
    """A piece of the video file that the source reads.  frame: its number, from 0.

    name: of the file.    size: of the whole file, in bytes.    offset: of ``data`` in it.
    """

    name: str
    size: int
    offset: int
    data: bytes


@dataclass(frozen=True, kw_only=True)
class Depth(Header):
    """The depth map of a frame as it came, a 16-bit image file; empty where there is none.

    ``pliant.datasets.depth.DepthRectifier`` makes metres of it.
    """

    data: bytes = b""


@dataclass(frozen=True, kw_only=True)
class ImuPiece(Header, ImuSamples):
    """The next inertial samples of the source.  frame: number of this piece, from 0; of a live
    source the number of the frame that it precedes.

    stamp_ns: 0; samples may be older than the first image.
    """


@dataclass(frozen=True, kw_only=True)
class GpsPiece(Header, GpsFixes):
    """The next satellite fixes of the source.  frame: number of this piece, from 0.

    stamp_ns: 0; fixes may be older than the first image.
    """


@dataclass(frozen=True, kw_only=True)
class Image(Header):
    """The rectified frame that all services process.

    grey: (H, W).     colour: (H, W, 3) RGB, or (0, 0, 3) where the source has none.
    missing: "" or why there are no pixels ("dropped", "broken: ..."); both arrays are empty then.
    jpeg, calibration: instead of colours, and over a link of all pixels, what they are made from:
    the source's JPEG and its camera as YAML; ``pliant_services.runtime.link_images`` makes them.
    unmapped: bundle adjustment only localises this frame, by its tracks, as it is behind (live
    mode).   unplaced: it is so far behind that it does not do that either.
    mask: which pixels are used, as of ``pliant.algorithms.image.masks``; b"": all of them.
    live: it was chosen in live mode, where a reader that stands still does not delay the others.
    """

    grey: Annotated[U8, Shape("H", "W")]
    colour: Annotated[U8, Shape("A", "B", 3)]
    missing: str = ""
    jpeg: bytes = b""
    calibration: str = ""
    unmapped: bool = False
    mask: bytes = b""
    unplaced: bool = False
    live: bool = False


@dataclass(frozen=True, kw_only=True)
class Extrema(Header, FrameTracks):
    """Tracks of a frame.  Its maxima are a function of its image: who needs them has that, too."""

    missing: str = ""


@dataclass(frozen=True, kw_only=True)
class MapUpdate(Header, MapDelta):
    """Everything that a frame changes in the map, at once."""


@dataclass(frozen=True, kw_only=True)
class Keyframe(Header, KeyframeDelta):
    """The changes of a frame in the observations of keyframes.

    jpeg: the rectified image of the new keyframe, colour where the source has it; empty without.
    earlier_ids, earlier_jpegs: keyframes that earlier frames became now that a map starts from
    them, and their images.
    mask, earlier_masks: theirs, as of ``Image``.
    """

    jpeg: bytes = b""
    earlier_ids: tuple[int, ...] = ()
    earlier_jpegs: tuple[bytes, ...] = ()
    mask: bytes = b""
    earlier_masks: tuple[bytes, ...] = ()

    def images(self) -> dict[int, bytes]:
        """All images of this message by the id of the keyframe."""
        found = dict(zip(self.earlier_ids, self.earlier_jpegs, strict=False))
        return {**found, self.new: self.jpeg} if self.new >= 0 else found

    def masks(self) -> dict[int, bytes]:
        """The masks of these images that have one, by the id of the keyframe."""
        found = dict(zip(self.earlier_ids, self.earlier_masks, strict=False))
        return {number: mask for number, mask in (*found.items(), (self.new, self.mask)) if mask}


@dataclass(frozen=True, kw_only=True)
class MapKeyframe(Header, KeptKeyframe):
    """A keyframe of a map that is kept over sessions.  frame: its number in the map, from 0."""


@dataclass(frozen=True, kw_only=True)
class MeshUpdate(Header, MeshBlocks):
    """Blocks of the live mesh: those that changed, or (``again``) unchanged ones.

    segment: of the map; a new one starts with an empty mesh.    voxel_size: in its units.
    first_key, last_key: of ``again``: between these packed keys, both included, there are no other
    blocks than those of this message; so a reader that missed an emptied block removes it.
    """

    segment: int
    voxel_size: float
    again: bool
    first_key: int = 0
    last_key: int = -1


@dataclass(frozen=True, kw_only=True)
class MeshPiece(Header):
    """A piece of a final mesh: its next vertices, and its next triangles.

    level: "fine" or "coarse".    piece, pieces: this one's number from 0, and how many there are.
    keyframes: how many were fused.    positions, normals, colours: of the vertices, RGB.
    triangles: rows of the vertices of all pieces.    closed: which of the vertices here, counted
    over all pieces, no keyframe saw: with their triangles they close holes.
    """

    segment: int
    level: str
    voxel_size: float
    keyframes: int
    piece: int
    pieces: int
    positions: Annotated[F32, Shape("V", 3)]
    normals: Annotated[F32, Shape("V", 3)]
    colours: Annotated[U8, Shape("V", 3)]
    triangles: Annotated[I32, Shape("T", 3)]
    closed: Annotated[I32, Shape("C")] = field(default_factory=no_rows)


@dataclass(frozen=True, kw_only=True)
class DeformingLandmarks(Header, WindowMap):
    """The map of the last seconds of a scene that deforms; most frames have none."""


@dataclass(frozen=True, kw_only=True)
class Surfels(Header, SurfelFrame):
    """All surfels in a frame; ``age`` and ``born`` count the frames that have pixels.

    missing: "" or why the frame has none: no pixels, or no depth so far.     note: "" or what is
    wrong with the depth of this frame.
    """

    missing: str = ""
    note: str = ""


CAPTURED, REPORTED = "captured_s", "reported_s"
"""Counters that are times: when an image came (live mode), and when a status was made."""


@dataclass(frozen=True, kw_only=True)
class Status(Header):
    """How a service fares; never an input of another one.

    stages, seconds: time spent on this frame by stage.   counters, values: what the service counts.
    note: one line for the user, "" for none.
    """

    service: str
    note: str
    stages: tuple[str, ...]
    seconds: Annotated[F64, Shape("S")]
    counters: tuple[str, ...]
    values: Annotated[F64, Shape("C")]


@dataclass(frozen=True, kw_only=True)
class StreamEnd(Header):
    """Closes a topic.  messages: how many it carried.   complete: False after an interruption."""

    topic: str
    messages: int
    complete: bool
