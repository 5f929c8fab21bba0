"""A run as topics of ROS 2.

    /tf                          map -> world -> camera_optical_frame -> camera_link, every frame
    NAME/pose                    PoseStamped of camera_link in map, every frame
    NAME/camera/image/compressed, NAME/camera/camera_info    every frame
    NAME/path                    Path: the keyframes
    NAME/points                  PointCloud2: the whole cloud, every ten frames
    NAME/mesh, NAME/surfels      Marker, TRIANGLE_LIST: the pieces that changed

Axes are REP-103's: map has z up, with x along the first view; camera_link x forward, y left, z up;
the optical frame x right, y down, z forward.  Stamps are capture times.  Path, points and mesh are
repeated for later subscribers.
"""

from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, matrix_to_pose, pose_to_matrix
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.ros.definitions import header, made, serialised
from pliant.ros.graph import Node, Publisher, RosTopic
from pliant.viewers.canvas import Moment
from pliant.viewers.foxglove import LEVEL_XYZW, Z_UP_XYZW, world_name
from pliant.viewers.point_blocks import PointBlocks
from pliant.viewers.surfel_quads import SurfelPicture

MAP, OPTICAL, LINK = "map", "camera_optical_frame", "camera_link"
_UP = np.array([0.0, 0.0, 0.0, *Z_UP_XYZW])  # the pose in map of a world that a camera began
_FLOAT32 = 7  # sensor_msgs/msg/PointField
_TRIANGLE_LIST, _ADD, _DELETE, _DELETE_ALL = 11, 0, 2, 3  # visualization_msgs/msg/Marker
_ROW = np.dtype([("xyz", "<f4", 3), ("bgr0", "u1", 4)])
# Bytes of a Marker in CDR: before all, of two empty lists, and of what comes behind points and
# colours when there is no message.
_ENCAPSULATION, _COUNTS, _BEHIND = 4, 8, 69
_STILL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])

Make = Callable[[], bytes]


class RosCanvas:
    """A canvas that is a node of ROS 2."""

    is_watched = True
    dims_masks = False

    def __init__(self, node: Node, name: str) -> None:
        """name: what all topics but /tf begin with, such as /pliant."""
        self._camera: PinholeCamera | None = None
        self._lens = (0.0, 0.0)
        self._world = _UP
        self._ids: dict[str, int] = {}
        self._kept: defaultdict[str, dict[str, Make]] = defaultdict(dict)
        self._came: set[str] = set()
        self._topics: dict[str, str] = {}
        self._publishers: dict[str, Publisher] = {}
        for key, topic, kind, keeps_all in (
            ("tf", "/tf", "tf2_msgs/msg/TFMessage", False),
            ("pose", f"{name}/pose", "geometry_msgs/msg/PoseStamped", False),
            ("image", f"{name}/camera/image/compressed", "sensor_msgs/msg/CompressedImage", False),
            ("camera", f"{name}/camera/camera_info", "sensor_msgs/msg/CameraInfo", False),
            ("path", f"{name}/path", "nav_msgs/msg/Path", True),
            ("points", f"{name}/points", "sensor_msgs/msg/PointCloud2", True),
            ("mesh", f"{name}/mesh", "visualization_msgs/msg/Marker", True),
            ("surfels", f"{name}/surfels", "visualization_msgs/msg/Marker", False),
        ):
            self._publishers[key] = node.publisher(RosTopic.of(topic, kind), keeps_all=keeps_all)
            self._topics[topic] = key
        node.on_subscription(lambda topic: self._came.add(self._topics.get(topic, "")))

    # -- the canvas ----------------------------------------------------------------------------

    def camera(
        self, at: Moment, camera: PinholeCamera, lens: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """Keep the camera: it goes with every image."""
        self._camera, self._lens = camera, lens

    def level(self) -> None:
        """The worlds are turned as the map is."""
        self._world = np.array([0.0, 0.0, 0.0, *LEVEL_XYZW])

    def image(self, at: Moment, data: bytes, encoding: str) -> None:
        """The image and its camera."""
        self._publish("image", partial(_image, at, data, encoding))
        if self._camera is not None:
            self._publish("camera", partial(_camera_info, at, self._camera, self._lens))
        self._publish_again()

    def tracks(self, at: Moment, points_px: F32, ages: I32) -> None:
        """ROS has no message for them."""

    def pose(self, at: Moment, segment: int, pose_world_camera: F64) -> None:
        """The transforms that place the camera, and its pose."""
        world = world_name(segment)
        frames = ((MAP, world, self._world), (world, OPTICAL, pose_world_camera))
        frames = (*frames, (OPTICAL, LINK, matrix_to_pose(inverse(pose_to_matrix(_UP)))))
        self._publish("tf", partial(_transforms, at, frames))
        T_map_optical = pose_to_matrix(self._world) @ pose_to_matrix(pose_world_camera)
        T_map_link = T_map_optical @ inverse(pose_to_matrix(_UP))
        pose = _pose(matrix_to_pose(T_map_link))
        kind = "geometry_msgs/msg/PoseStamped"
        stamped = made(kind, header=header(at.stamp_ns, MAP), pose=pose)
        self._publish("pose", partial(serialised, stamped))

    def path(self, at: Moment, segment: int, positions: F64) -> None:
        """Publish the keyframes, without their directions."""
        self._publish("path", partial(_path, at, world_name(segment), positions), keep="")

    def places(self, at: Moment, segment: int, lines: F64) -> None:
        """Not published: the path shows where the camera was."""

    def points(self, at: Moment, segment: int, points: PointBlocks, changed: list[int]) -> None:
        """The cloud."""
        self._publish("points", partial(_cloud, at, world_name(segment), points), keep="")

    def whole_map(self, at: Moment, segment: int, points: PointBlocks) -> None:
        """The cloud."""
        self.points(at, segment, points, [])

    def mesh(self, at: Moment, segment: int, name: str, mesh: TriangleMesh) -> None:
        """A marker for each piece."""
        number = self._ids.setdefault(name, len(self._ids))
        self._publish(
            "mesh", partial(marker, at, world_name(segment), "mesh", number, mesh), keep=name
        )
        if not len(mesh.triangles):
            self._kept["mesh"].pop(name, None)

    def surfels(self, at: Moment, segment: int, surfels: SurfelPicture) -> None:
        """One marker."""
        self._publish(
            "surfels", partial(marker, at, world_name(segment), "surfels", 0, surfels.quads)
        )

    def surface(self, at: Moment, segment: int, mesh: TriangleMesh) -> None:
        """One more marker of the surfels."""
        make = partial(marker, at, world_name(segment), "surface", 0, mesh)
        self._publish("surfels", make)

    def forget(self, at: Moment, segment: int) -> None:
        """Take the mesh of a segment away."""
        self._kept.clear()
        for key in ("mesh", "surfels"):
            gone = made(
                "visualization_msgs/msg/Marker",
                header=header(at.stamp_ns, world_name(segment)),
                action=_DELETE_ALL,
            )
            self._publish(key, partial(serialised, gone))

    def measure(self, at: Moment, name: str, value: float) -> None:
        """ROS has no message for it."""

    def note(self, at: Moment, text: str) -> None:
        """Not published: ROS has no use for it."""

    # -- sending -------------------------------------------------------------------------------

    def _publish(self, key: str, make: Make, *, keep: str | None = None) -> None:
        """Publish if there are subscribers.  keep: name under which it is repeated for
        later ones.
        """
        if keep is not None:
            self._kept[key][keep] = make
        if self._publishers[key].is_heard:
            self._publishers[key].put(make())

    def _publish_again(self) -> None:
        """Repeat messages for new subscribers: here, because Zenoh may not be called from a
        callback.
        """
        while self._came:
            key = self._came.pop()
            for make in list(self._kept[key].values()):
                self._publishers[key].put(make())


def _image(at: Moment, data: bytes, encoding: str) -> bytes:
    pixels = np.frombuffer(data, np.uint8)
    kind = "sensor_msgs/msg/CompressedImage"
    return serialised(made(kind, header=header(at.stamp_ns, OPTICAL), format=encoding, data=pixels))


def _camera_info(at: Moment, camera: PinholeCamera, lens: tuple[float, float]) -> bytes:
    K = camera.K
    message = made(
        "sensor_msgs/msg/CameraInfo",
        header=header(at.stamp_ns, OPTICAL), height=camera.height, width=camera.width,
        distortion_model="plumb_bob", d=[*lens, 0.0, 0.0, 0.0], k=K.ravel(),
        r=np.eye(3).ravel(), p=np.hstack([K, np.zeros((3, 1))]).ravel(),
    )  # fmt: skip
    return serialised(message)


def _transforms(at: Moment, frames: tuple[tuple[str, str, F64], ...]) -> bytes:
    transforms = [
        made(
            "geometry_msgs/msg/TransformStamped",
            header=header(at.stamp_ns, parent),
            child_frame_id=child,
            transform={
                "translation": _record("xyz", pose[:3]),
                "rotation": _record("xyzw", pose[3:]),
            },
        )
        for parent, child, pose in frames
    ]
    return serialised(made("tf2_msgs/msg/TFMessage", transforms=transforms))


def _path(at: Moment, frame_id: str, positions: F64) -> bytes:
    kind, stamped = "geometry_msgs/msg/PoseStamped", header(at.stamp_ns, frame_id)
    poses = [
        made(kind, header=stamped, pose=_pose(np.array([*position, *_STILL[3:]])))
        for position in positions
    ]
    return serialised(made("nav_msgs/msg/Path", header=stamped, poses=poses))


def _cloud(at: Moment, frame_id: str, points: PointBlocks) -> bytes:
    xyz, rgb = points.everything()
    rows = np.zeros(len(xyz), _ROW)
    rows["xyz"], rows["bgr0"][:, :3] = xyz, rgb[:, ::-1]
    fields = [
        made("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=_FLOAT32, count=1)
        for i, name in enumerate(("x", "y", "z", "rgb"))
    ]
    message = made(
        "sensor_msgs/msg/PointCloud2",
        header=header(at.stamp_ns, frame_id), height=1, width=len(rows), fields=fields,
        point_step=_ROW.itemsize, row_step=rows.nbytes, is_dense=True,
        data=np.frombuffer(rows.tobytes(), np.uint8),
    )  # fmt: skip
    return serialised(message)


def marker(at: Moment, frame_id: str, ns: str, number: int, mesh: TriangleMesh) -> bytes:
    """A Marker with three points and three colours for each triangle; without any it goes."""
    kind = "visualization_msgs/msg/Marker"
    fields: dict[str, Any] = {
        "header": header(at.stamp_ns, frame_id), "ns": ns, "id": number, "type": _TRIANGLE_LIST,
        "action": _ADD if len(mesh.triangles) else _DELETE, "pose": _pose(_STILL),
        "scale": _record("xyz", np.ones(3)), "color": _record("rgba", np.ones(4)),
    }  # fmt: skip
    empty = serialised(made(kind, **fields))
    if not len(mesh.triangles):
        return empty
    # Records one by one are slow: they are laid out here, in place of the two empty lists.  Behind
    # them nothing is aligned to more than the 4 bytes of which they are multiples.
    begin = len(empty) - _BEHIND - _COUNTS
    corners = mesh.triangles.ravel()
    colours = np.ones((len(corners), 4), "<f4")
    colours[:, :3] = mesh.colours[corners] / 255.0
    count = np.array([len(corners)], "<u4").tobytes()
    gap = bytes(-(begin + len(count) - _ENCAPSULATION) % 8)
    positions = mesh.positions[corners].astype("<f8").tobytes()
    lists = count + gap + positions + count + colours.tobytes()
    return empty[:begin] + lists + empty[-_BEHIND:]


def _pose(pose: F64) -> dict[str, Any]:
    return {"position": _record("xyz", pose[:3]), "orientation": _record("xyzw", pose[3:])}


def _record(names: str, values: F64) -> dict[str, float]:
    return dict(zip(names, values.tolist(), strict=True))
