"""A run as Foxglove protobuf messages in an MCAP file, which opens without Pliant.

    /camera/image, /camera/calibration, /camera/tracks   every frame; the corrected one at the end
    /tf              map -> world -> camera, every frame with a pose
    /map/points      the points that changed, every ten frames
    /map/path        positions of the keyframes
    /map/places      lines between keyframes that show one place
    /map/mesh        surface: the live mesh as it grew, then the final one in its place
    /map/all_points  the whole map, once, at the end of a segment
    /surfels/quads, .../points, .../image, .../mesh   every frame of the deformable profile

Stamps are capture times: a recording gives the same bytes each time.  Poses and points are as they
were known at the time.  Needs its definitions: ``pip install 'pliant[foxglove]'``.
"""

import importlib
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer

from pliant.algorithms.arrays import F32, F64, I32, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.errors import ResultError
from pliant.pictures.map import PLACES_COLOUR
from pliant.viewers.age_colours import age_buckets
from pliant.viewers.canvas import Moment
from pliant.viewers.point_blocks import PointBlocks
from pliant.viewers.surfel_quads import SurfelPicture

_ROW = np.dtype([("xyz", "<f4", 3), ("rgba", "u1", 4)])
_FLOAT32, _UINT8 = 7, 1  # foxglove.PackedElementField.NumericType
_POINTS, _LINE_STRIP, _LINE_LIST = 1, 0, 2  # foxglove.PointsAnnotation.Type, LinePrimitive.Type
_THIS_ENTITY, _ALL_ENTITIES = 0, 1  # foxglove.SceneEntityDeletion.Type, of the topic
_ENTITY_FACES = 50_000
Z_UP_XYZW = (-0.5, 0.5, -0.5, 0.5)
"""Rotation of R_map_world: the first camera looks along x of the map, whose z is up (REP-103)."""
LEVEL_XYZW = (0.0, 0.0, 0.0, 1.0)
"""As this, of a world whose z is up."""


def world_name(segment: int) -> str:
    """The coordinate frame of a map segment."""
    return "world" if segment <= 0 else f"world_{segment}"


class FoxgloveFile:
    """A canvas that is an MCAP file.  A context manager: leaving it closes the file."""

    dims_masks = True

    def __init__(self, path: Path) -> None:
        """Raises ResultError if the definitions are missing or the file cannot be written."""
        self._path = path
        self._kinds: dict[str, Any] = {}
        self._channels: dict[str, int] = {}
        self._sequences: dict[str, int] = {}
        self._camera: PinholeCamera | None = None
        self._lens = (0.0, 0.0)
        self._turned_xyzw = Z_UP_XYZW
        self._parts: dict[str, int] = {}
        self._kind("PointCloud")  # said now, before a file is there
        try:
            self._file = path.open("wb")
        except OSError as error:
            raise ResultError(f"{path}: cannot be written ({error.strerror})") from None
        self._writer = Writer(self._file, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library="pliant")

    def __enter__(self) -> "FoxgloveFile":
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._writer.finish()
            self._file.close()
        except OSError as failure:
            raise ResultError(f"{self._path}: cannot be written ({failure.strerror})") from None

    # -- the canvas ----------------------------------------------------------------------------

    def camera(
        self, at: Moment, camera: PinholeCamera, lens: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """Keep the camera: it is written with every image, and when it is corrected."""
        is_correction = self._camera is not None
        self._camera, self._lens = camera, lens
        if is_correction:
            self._write_calibration(at)

    def level(self) -> None:
        """The worlds are turned as the map is."""
        self._turned_xyzw = LEVEL_XYZW

    def image(self, at: Moment, data: bytes, encoding: str) -> None:
        """The image and its calibration."""
        image = self._kind("CompressedImage")(frame_id="camera", data=data, format=encoding)
        self._write("/camera/image", at, image)
        self._write_calibration(at)

    def tracks(self, at: Moment, points_px: F32, ages: I32) -> None:
        """Tracks by age, blue to orange; circles would be too many."""
        annotations = self._kind("ImageAnnotations")()
        for rows, (red, green, blue) in age_buckets(ages):
            group = annotations.points.add(type=_POINTS, thickness=2.0)
            group.timestamp.FromNanoseconds(at.stamp_ns)
            group.outline_color.CopyFrom(self._colour(red, green, blue))
            for u, v in points_px[rows].tolist():
                group.points.add(x=u, y=v)
        self._write("/camera/tracks", at, annotations, stamped=False)

    def pose(self, at: Moment, segment: int, pose_world_camera: F64) -> None:
        """The two transforms that place the camera."""
        both = self._kind("FrameTransforms")()
        world = world_name(segment)
        turned = (0.0, 0.0, 0.0, *self._turned_xyzw)
        poses = (("map", world, turned), (world, "camera", pose_world_camera))
        for parent, child, pose in poses:
            transform = both.transforms.add(parent_frame_id=parent, child_frame_id=child)
            transform.timestamp.FromNanoseconds(at.stamp_ns)
            _fill(transform.translation, "xyz", pose[:3])
            _fill(transform.rotation, "xyzw", pose[3:])
        self._write("/tf", at, both, stamped=False)

    def path(self, at: Moment, segment: int, positions: F64) -> None:
        """One line through the keyframes."""
        update, entity = self._entity(at, segment, "path")
        line = entity.lines.add(type=_LINE_STRIP, thickness=2.0, scale_invariant=True)
        line.pose.orientation.w = 1.0
        line.color.CopyFrom(self._colour(255, 160, 0))
        for position in positions.tolist():
            _fill(line.points.add(), "xyz", position)
        self._write("/map/path", at, update, stamped=False)

    def places(self, at: Moment, segment: int, lines: F64) -> None:
        """A line for each pair."""
        update, entity = self._entity(at, segment, "places")
        line = entity.lines.add(type=_LINE_LIST, thickness=2.0, scale_invariant=True)
        line.pose.orientation.w = 1.0
        line.color.CopyFrom(self._colour(*PLACES_COLOUR))
        for position in lines.reshape(-1, 3).tolist():
            _fill(line.points.add(), "xyz", position)
        self._write("/map/places", at, update, stamped=False)

    def points(self, at: Moment, segment: int, points: PointBlocks, changed: list[int]) -> None:
        """The region that changes."""
        self._write("/map/points", at, self._cloud(segment, *points.blocks(changed)))

    def whole_map(self, at: Moment, segment: int, points: PointBlocks) -> None:
        """Everything."""
        self._write("/map/all_points", at, self._cloud(segment, *points.everything()))

    def mesh(self, at: Moment, segment: int, name: str, mesh: TriangleMesh) -> None:
        """A surface, in entities of 50,000 triangles."""
        starts = range(0, len(mesh.triangles), _ENTITY_FACES)
        for part, first in enumerate(starts):
            update, entity = self._entity(at, segment, f"{name}/{part}")
            _add_triangles(entity, mesh.of_triangles(slice(first, first + _ENTITY_FACES)))
            self._write("/map/mesh", at, update, stamped=False)
        for part in range(len(starts), self._parts.get(name, 0)):
            update = self._kind("SceneUpdate")()
            deletion = update.deletions.add(type=_THIS_ENTITY, id=f"{name}/{part}")
            deletion.timestamp.FromNanoseconds(at.stamp_ns)
            self._write("/map/mesh", at, update, stamped=False)
        self._parts[name] = len(starts)

    def surfels(self, at: Moment, segment: int, surfels: SurfelPicture) -> None:
        """Quads, their centres for readers that know no quads, and those on the image."""
        update, entity = self._entity(at, segment, "surfels")
        _add_triangles(entity, surfels.quads)
        self._write("/surfels/quads", at, update, stamped=False)
        cloud = self._cloud(segment, surfels.centres, surfels.colours)
        self._write("/surfels/points", at, cloud)
        annotations = self._kind("ImageAnnotations")()
        if len(surfels.points_px):
            group = annotations.points.add(type=_POINTS, thickness=4.0)
            group.timestamp.FromNanoseconds(at.stamp_ns)
            for (u, v), rgb in zip(
                surfels.points_px.tolist(), surfels.point_colours.tolist(), strict=True
            ):
                group.points.add(x=u, y=v)
                group.outline_colors.append(self._colour(*rgb))
        self._write("/surfels/image", at, annotations, stamped=False)

    def surface(self, at: Moment, segment: int, mesh: TriangleMesh) -> None:
        """One entity."""
        update, entity = self._entity(at, segment, "surface")
        _add_triangles(entity, mesh)
        self._write("/surfels/mesh", at, update, stamped=False)

    def forget(self, at: Moment, segment: int) -> None:
        """Take the lines and the mesh of a segment away."""
        update = self._kind("SceneUpdate")()
        deletion = update.deletions.add(type=_ALL_ENTITIES)
        deletion.timestamp.FromNanoseconds(at.stamp_ns)
        self._parts.clear()
        for topic in ("/map/path", "/map/places", "/map/mesh", "/surfels/quads", "/surfels/mesh"):
            if topic in self._channels:
                self._write(topic, at, update, stamped=False)

    def measure(self, at: Moment, name: str, value: float) -> None:
        """Times are no part of the file: they differ from run to run."""

    def note(self, at: Moment, text: str) -> None:
        """A line in Foxglove's log panel."""
        self._write("/notes", at, self._kind("Log")(level=2, message=text, name="pliant"))

    # -- writing -------------------------------------------------------------------------------

    def _write_calibration(self, at: Moment) -> None:
        if self._camera is None:
            return
        c, K = self._camera, self._camera.K
        P = np.concatenate([K, np.zeros((3, 1))], axis=1)
        calibration = self._kind("CameraCalibration")(
            frame_id="camera", width=c.width, height=c.height, distortion_model="plumb_bob",
            D=[*self._lens, 0.0, 0.0, 0.0], K=K.ravel().tolist(), R=np.eye(3).ravel().tolist(),
            P=P.ravel().tolist(),
        )  # fmt: skip
        self._write("/camera/calibration", at, calibration)

    def _cloud(self, segment: int, xyz: F32, rgb: U8) -> Any:
        rows = np.zeros(len(xyz), _ROW)
        rows["xyz"], rows["rgba"][:, :3], rows["rgba"][:, 3] = xyz, rgb, 255
        cloud = self._kind("PointCloud")(
            frame_id=world_name(segment), point_stride=_ROW.itemsize, data=rows.tobytes()
        )
        cloud.pose.position.SetInParent()  # write zeros, too: some readers require them
        cloud.pose.orientation.w = 1.0
        for i, name in enumerate("xyz"):
            cloud.fields.add(name=name, offset=4 * i, type=_FLOAT32)
        for i, name in enumerate(("red", "green", "blue", "alpha")):
            cloud.fields.add(name=name, offset=12 + i, type=_UINT8)
        return cloud

    def _entity(self, at: Moment, segment: int, name: str) -> tuple[Any, Any]:
        update = self._kind("SceneUpdate")()
        entity = update.entities.add(frame_id=world_name(segment), id=name)
        entity.timestamp.FromNanoseconds(at.stamp_ns)
        return update, entity

    def _colour(self, red: int, green: int, blue: int) -> Any:
        return self._kind("Color")(r=red / 255.0, g=green / 255.0, b=blue / 255.0, a=1.0)

    def _kind(self, name: str) -> Any:
        if name not in self._kinds:
            try:
                module: Any = importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2")
            except ImportError:
                raise ResultError(
                    "--to foxglove needs the definitions of its messages: "
                    "pip install 'pliant[foxglove]'"
                ) from None
            self._kinds[name] = getattr(module, name)
        return self._kinds[name]

    def _write(self, topic: str, at: Moment, message: Any, *, stamped: bool = True) -> None:
        if stamped:
            message.timestamp.FromNanoseconds(at.stamp_ns)
        sequence = self._sequences[topic] = self._sequences.get(topic, -1) + 1
        try:
            if topic not in self._channels:
                self._channels[topic] = self._register(topic, type(message))
            self._writer.add_message(
                self._channels[topic],
                log_time=at.stamp_ns,
                publish_time=at.stamp_ns,
                sequence=sequence,
                data=message.SerializeToString(deterministic=True),
            )
        except OSError as error:
            raise ResultError(f"{self._path}: cannot be written ({error.strerror})") from None

    def _register(self, topic: str, kind: Any) -> int:
        schema = self._writer.register_schema(
            kind.DESCRIPTOR.full_name, "protobuf", _definitions(kind)
        )
        return self._writer.register_channel(topic, "protobuf", schema)


def _definitions(kind: Any) -> bytes:
    """The definition of a message with those of all that it is made of: a FileDescriptorSet."""
    descriptors: Any = importlib.import_module("google.protobuf.descriptor_pb2")
    files = descriptors.FileDescriptorSet()
    waiting, seen = deque([kind.DESCRIPTOR.file]), {kind.DESCRIPTOR.file.name}
    ordered: list[Any] = []
    while waiting:
        ordered.append(waiting.popleft())
        for other in ordered[-1].dependencies:
            if other.name not in seen:
                seen.add(other.name)
                waiting.append(other)
    for file in reversed(ordered):
        file.CopyToProto(files.file.add())
    data: bytes = files.SerializeToString(deterministic=True)
    return data


def _add_triangles(entity: Any, mesh: TriangleMesh) -> None:
    """Fill a list of triangles; its two lists of records are laid out here, one by one is slow."""
    triangles = entity.triangles.add()
    triangles.pose.orientation.w = 1.0
    numbers = {name: f.number for name, f in triangles.DESCRIPTOR.fields_by_name.items()}
    colours = np.concatenate([mesh.colours / 255.0, np.ones((len(mesh.colours), 1))], axis=1)
    triangles.MergeFromString(
        _records(numbers["points"], mesh.positions) + _records(numbers["colors"], colours)
    )
    triangles.indices.extend(mesh.triangles.ravel().tolist())


def _records(number: int, rows: F32 | F64) -> bytes:
    """Rows of doubles as the protobuf records that a repeated field holds."""
    width = rows.shape[1]
    layout = np.dtype(
        [("tag", "u1"), ("size", "u1"), ("row", [("tag", "u1"), ("x", "<f8")], width)]
    )
    records = np.zeros(len(rows), layout)
    records["tag"], records["size"] = number << 3 | 2, 9 * width  # length-delimited
    records["row"]["tag"] = np.arange(1, width + 1) << 3 | 1  # 64 bits
    records["row"]["x"] = rows
    return records.tobytes()


def _fill(record: Any, names: str, values: Any) -> None:
    for name, value in zip(names, values, strict=True):
        setattr(record, name, float(value))
