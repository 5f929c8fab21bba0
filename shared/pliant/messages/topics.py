"""The one table of topics."""

from dataclasses import dataclass

from pliant.messages.types import (
    CameraStream,
    ClipPiece,
    DeformingLandmarks,
    Depth,
    Extrema,
    GpsPiece,
    Header,
    Image,
    ImuPiece,
    Keyframe,
    MapKeyframe,
    MapUpdate,
    MeshPiece,
    MeshUpdate,
    SourceImage,
    Status,
    StreamEnd,
    Surfels,
)

_MIB = 1 << 20


@dataclass(frozen=True)
class Topic:
    """A named stream of messages of one type, each with a sequence number, closed by an end."""

    key: str
    """Without the session's prefix."""
    message: type[Header]
    per_frame: bool
    """Exactly one message for every frame, possibly empty."""
    deterministic: bool = True
    """Same input, same bytes.  False for status and timings."""
    logged: bool = True
    newest_wins: bool = False
    """In live mode the next is not chosen before the last was taken, which readers tell at once."""
    max_bytes: int = 16 * _MIB
    """A larger message is refused before memory is taken for it."""
    kept_whole: bool = False
    """Its readers may take in all of it before they come to a checkpoint, so senders keep all."""
    viewed: int = 0
    """Viewers draw it: this many of its newest messages are kept for a slow one."""
    compression: str = "zstd"
    """How its chunks of a recording are stored: "" as they are, or "zstd"."""


STREAM = Topic("camera/stream", CameraStream, per_frame=False, max_bytes=_MIB)
# Not compressed: most images come compressed, and of raw ones zstd saves a tenth.
SOURCE = Topic(
    "camera/source", SourceImage, per_frame=True, max_bytes=128 * _MIB, viewed=2, compression=""
)
# The file of a video, before the first frame: a recording has it instead of raw frames.
CLIP = Topic("camera/clip", ClipPiece, per_frame=False, compression="")
# Not logged: made again from camera/source and the calibration.
IMAGE = Topic(
    "camera/image", Image, per_frame=True, logged=False, newest_wins=True, max_bytes=128 * _MIB
)
# Empty if only the recorder would read it.
DEPTH = Topic("camera/depth", Depth, per_frame=True, max_bytes=128 * _MIB, compression="")
# All that the source's other sensors measured, before the first frame: nothing if it has none.
# Of a live source, samples come with the frames, and fixes after the last one.
IMU = Topic("imu/samples", ImuPiece, per_frame=False, max_bytes=_MIB, kept_whole=True)
GPS = Topic("gps/fixes", GpsPiece, per_frame=False, max_bytes=_MIB)
# The map of earlier sessions, before the first frame: nothing if a run begins without one.
MAP_KNOWN = Topic("map/known", MapKeyframe, per_frame=False, max_bytes=64 * _MIB, kept_whole=True)
EXTREMA = Topic("tracks/extrema", Extrema, per_frame=True, viewed=2)
# Updates are deltas: what a viewer has lost it waits for until the next snapshot.
MAP_UPDATE = Topic("map/update", MapUpdate, per_frame=True, max_bytes=64 * _MIB, viewed=256)
# One message, after the last frame: what is only known once nothing more can come.
MAP_FINAL = Topic("map/final", MapUpdate, per_frame=False, max_bytes=512 * _MIB, viewed=256)
KEYFRAME = Topic("map/keyframe", Keyframe, per_frame=True, max_bytes=64 * _MIB)
# One message, after the last frame: the keyframes that were still in the window, and all that a
# second pass has made, with their images.
KEYFRAME_FINAL = Topic("map/keyframe_final", Keyframe, per_frame=False, max_bytes=512 * _MIB)
# After the last frame: the map with all that was known, for sessions to come.
MAP_KEPT = Topic("map/kept", MapKeyframe, per_frame=False, max_bytes=64 * _MIB)
# In live mode, the published part of the live mesh depends on the time.
# For viewers the changed blocks of 32 keyframes, or a final mesh of 8 million triangles.
MESH_BLOCKS = Topic("mesh/blocks", MeshUpdate, per_frame=False, max_bytes=256 * _MIB, viewed=64)
MESH_FINAL = Topic("mesh/final", MeshPiece, per_frame=False, viewed=64)
SURFELS = Topic("surfels/state", Surfels, per_frame=True, max_bytes=64 * _MIB, viewed=2)
MAP_DEFORMING = Topic("map/deforming", DeformingLandmarks, per_frame=True)
STREAM_END = Topic("stream/end", StreamEnd, per_frame=False, max_bytes=_MIB)


def status(service: str) -> Topic:
    """The status topic of one service."""
    return Topic(f"status/{service}", Status, per_frame=False, deterministic=False, max_bytes=_MIB)


TOPICS = (
    STREAM, CLIP, SOURCE, IMAGE, DEPTH, IMU, GPS, MAP_KNOWN, EXTREMA, MAP_UPDATE, MAP_FINAL,
    KEYFRAME, KEYFRAME_FINAL, MAP_KEPT, MESH_BLOCKS, MESH_FINAL, MAP_DEFORMING, SURFELS,
    STREAM_END,
)  # fmt: skip
WITH_PIXELS = (IMAGE, SOURCE)
"""Topics that are compressed for a link between machines."""
VIEWED = tuple(topic for topic in TOPICS if topic.viewed)
_BY_KEY = {topic.key: topic for topic in TOPICS}


def by_key(key: str) -> Topic | None:
    """The topic of a key, also the status of a service that this table does not name."""
    parent, _, service = key.partition("/")
    return status(service) if parent == "status" and service else _BY_KEY.get(key)
