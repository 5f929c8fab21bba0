"""ROS 2 over rmw_zenoh's keys: the layout as its docs/design.md has it, and messages as CDR."""

import itertools
import queue
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import recorded_messages as bags
import zenoh

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.bus.session import open_session
from pliant.datasets import decode, open_source
from pliant.datasets.ros_camera import RosCamera
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import CalibrationError, DatasetError
from pliant.viewers.canvas import Moment
from pliant.viewers.point_blocks import PointBlocks

typesys: Any = pytest.importorskip("rosbags.typesys")

from pliant.ros.definitions import RosError, made, serialised  # noqa: E402
from pliant.ros.graph import Node, RosTopic, attachment, domain_id, token, topic_in  # noqa: E402
from pliant.viewers.ros import RosCanvas, marker  # noqa: E402

CHATTER = RosTopic.of("/chatter", "std_msgs/msg/String")
STRING = (
    "std_msgs::msg::dds_::String_/"
    "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
)
SESSION = "aac3178e146ba6f1fc6e6a4085e77f21"
# As type descriptions of ROS 2 Jazzy have them (/opt/ros/jazzy/share/*/msg/*.json).
HASHES = {
    "geometry_msgs/msg/PoseStamped": "10f3786d7d40fd2b54367835614bff85"
    "d4ad3b5dab62bf8bca0cc232d73b4cd8",
    "nav_msgs/msg/Path": "1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b",
    "sensor_msgs/msg/CameraInfo": "b3dfd68ff46c9d56c80fd3bd4ed22c7a"
    "4ddce8c8348f2f59c299e73118e7e275",
    "sensor_msgs/msg/CompressedImage": "15640771531571185e2efc8a100baf92"
    "3961a4d15d5569652e6cb6691e8e371a",
    "sensor_msgs/msg/Image": "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    "sensor_msgs/msg/PointCloud2": "9198cabf7da3796ae6fe19c4cb3bdd35"
    "25492988c70522628af5daa124bae2b5",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "visualization_msgs/msg/Marker": "45b13ccf791f225962bf74e746f96445"
    "18855d783a6f42ba0cc14fde2b4f3ce0",
}
SQUARE = TriangleMesh(
    positions=np.array([(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)], np.float32),
    normals=np.array([(0, 0, -1)] * 4, np.float32),
    colours=np.array([(255, 0, 0), (0, 255, 0), (0, 0, 255), (51, 51, 51)], np.uint8),
    triangles=np.array([(0, 1, 2), (0, 2, 3)], np.int32),
)
NOTHING = TriangleMesh(
    positions=SQUARE.positions[:0], normals=SQUARE.normals[:0],
    colours=SQUARE.colours[:0], triangles=SQUARE.triangles[:0],
)  # fmt: skip
PATIENCE_S = 30.0


def read(data: bytes, kind: str) -> Any:
    """By a store of its own, of another release: nothing of ours."""
    return typesys.get_typestore(typesys.Stores.ROS2_KILTED).deserialize_cdr(data, kind)


def test_keys_are_those_of_the_design_document() -> None:
    assert CHATTER.key(0) == f"0/chatter/{STRING}"
    assert RosTopic.of("/robot1/chatter", CHATTER.kind).key(0) == f"0/robot1/chatter/{STRING}"
    assert token("NN", 2, SESSION, "/listener") == f"@ros2_lv/2/{SESSION}/0/0/NN/%/%/listener"
    subscription = f"@ros2_lv/2/{SESSION}/0/10/MS/%/%/listener/%chatter/{STRING}/::,10:,:,:,,"
    assert token("MS", 2, SESSION, "/listener", 10, CHATTER) == subscription
    assert topic_in(subscription) == CHATTER
    assert topic_in(f"@ros2_lv/2/{SESSION}/0/0/NN/%/%/listener") is None
    assert "/%/%robot1/listener" in token("NN", 2, SESSION, "/robot1/listener")


def test_the_attachment_is_what_zenoh_serialises() -> None:
    ext: Any = zenoh.ext
    gid = bytes(range(16))
    expected = ext.z_serialize((ext.Int64(7), ext.Int64(1 << 60), gid)).to_bytes()
    assert attachment(7, 1 << 60, gid) == expected
    assert len(expected) == 33


@pytest.mark.parametrize("kind", HASHES)
def test_hashes_are_those_that_ros_has(kind: str) -> None:
    assert RosTopic.of("/t", kind).hash == f"RIHS01_{HASHES[kind]}"


@pytest.mark.parametrize("ns", ["", "m", "me", "mes", "mesh", "mesh5", "mesh67", "mesh789"])
def test_a_mesh_is_read_as_it_was(ns: str) -> None:
    """Whatever lies before the lists moves them, and what is behind."""
    found = read(marker(Moment(3, 5), "world", ns, 4, SQUARE), "visualization_msgs/msg/Marker")
    assert (found.ns, found.id, found.type, found.action) == (ns, 4, 11, 0)
    corners = SQUARE.triangles.ravel()
    points = np.array([(p.x, p.y, p.z) for p in found.points])
    colours = np.array([(c.r, c.g, c.b, c.a) for c in found.colors])
    np.testing.assert_array_equal(points, SQUARE.positions[corners])
    np.testing.assert_allclose(colours[:, :3], SQUARE.colours[corners] / 255.0, atol=1e-7)
    assert (colours[:, 3] == 1.0).all()
    assert found.mesh_use_embedded_materials == 0
    gone = read(marker(Moment(3, 5), "world", ns, 4, NOTHING), "visualization_msgs/msg/Marker")
    assert (gone.id, gone.action, len(gone.points)) == (4, 2, 0)


def test_a_message_of_unknown_fields_is_refused() -> None:
    with pytest.raises(TypeError, match="wrong"):
        made("std_msgs/msg/String", wrong=1)


def test_the_domain_is_that_of_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    assert domain_id() == 7
    for wrong in ("seven", "-1", "233"):
        monkeypatch.setenv("ROS_DOMAIN_ID", wrong)
        with pytest.raises(RosError, match="ROS_DOMAIN_ID"):
            domain_id()


def wait_until_published(endpoint: str, *names: str, gone: bool = False) -> None:
    """Until a router knows of topics: those who publish have said so, but not yet been heard.

    gone: until it knows that they are no longer published."""
    with open_session([endpoint]) as session:
        node, pause = Node(session, "/watch"), threading.Event()
        for _ in range(int(PATIENCE_S / 0.02)):
            published = {topic.name for topic in node.published()}
            if not set(names) & published if gone else set(names) <= published:
                return
            pause.wait(0.02)
    raise AssertionError(f"{names} did not come")


class Reader:
    """A plain subscriber of Zenoh: what comes on each topic."""

    def __init__(self, session: zenoh.Session) -> None:
        self._waiting: dict[str, queue.Queue[tuple[Any, bytes]]] = {}
        self._held = session.declare_subscriber("0/**", self._take)

    def next(self, topic: str, patience_s: float = PATIENCE_S) -> tuple[Any, bytes]:
        """The next message of a topic, and what went along.  Raises queue.Empty."""
        return self._of(topic).get(timeout=patience_s)

    def _take(self, sample: zenoh.Sample) -> None:
        *name, kind, _ = str(sample.key_expr).split("/")[1:]
        ros = kind.replace("::msg::dds_::", "/msg/").removesuffix("_")
        went_along = sample.attachment.to_bytes() if sample.attachment is not None else b""
        self._of("/" + "/".join(name)).put((read(sample.payload.to_bytes(), ros), went_along))

    def _of(self, topic: str) -> "queue.Queue[tuple[Any, bytes]]":
        return self._waiting.setdefault(topic, queue.Queue())


def test_a_run_is_read_with_the_keys_alone(endpoint: str) -> None:
    at = Moment(2, 1_700_000_000_123_456_789)
    camera = PinholeCamera(width=8, height=6, fx=9.0, fy=10.0, cx=3.5, cy=2.5)
    points = PointBlocks()
    xyz, rgb = np.array([(1, 2, 3), (4, 5, 6)], np.float32), np.array([(9, 8, 7), (1, 2, 3)])
    ids = np.arange(2)
    points.update(ids, xyz, rgb.astype(np.uint8), ids * 0, ids[:0], snapshot=True)
    with open_session([endpoint]) as ours, open_session([endpoint]) as theirs:
        reader = Reader(theirs)
        canvas = RosCanvas(Node(ours, "/pliant"), "/pliant")
        # A publisher learns a little later that it is heard; what is kept is told to a newcomer.
        canvas.camera(at, camera, (0.1, 0.2))
        canvas.points(at, 0, points, [0])
        canvas.path(at, 0, np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 2.0)]))
        canvas.mesh(at, 0, "live/0", SQUARE)
        canvas.mesh(at, 0, "live/1", SQUARE)
        canvas.mesh(at, 0, "live/1", NOTHING)
        names = ("camera/camera_info", "camera/image/compressed", "mesh", "path", "points", "pose")
        wait_until_published(endpoint, "/tf", *(f"/pliant/{name}" for name in (*names, "surfels")))
        node = Node(theirs, "/rviz")
        subscriptions = [node.subscribe(topic, lambda data: None) for topic in node.published()]
        kept: dict[str, Any] = {}
        for frame in itertools.count():  # until each of the newcomers is known
            canvas.image(at, b"\xff\xd8\xff", "jpeg")
            canvas.pose(at, 0, np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0]))
            try:
                for name in {"mesh", "points", "path"} - kept.keys():
                    kept[name], _ = reader.next(f"/pliant/{name}", 0.1)
                break
            except queue.Empty:
                assert frame < 10 * PATIENCE_S
        image, went_along = reader.next("/pliant/camera/image/compressed")
        assert (image.format, bytes(image.data)) == ("jpeg", b"\xff\xd8\xff")
        assert image.header.stamp.sec * 10**9 + image.header.stamp.nanosec == at.stamp_ns
        assert image.header.frame_id == "camera_optical_frame"
        assert len(went_along) == 33
        info, _ = reader.next("/pliant/camera/camera_info")
        np.testing.assert_array_equal(info.k, camera.K.ravel())
        assert (info.width, info.height, info.d[:2].tolist()) == (8, 6, [0.1, 0.2])
        # Two units forward: along x of the map, and camera_link looks there.
        pose, _ = reader.next("/pliant/pose")
        position, orientation = pose.pose.position, pose.pose.orientation
        np.testing.assert_allclose((position.x, position.y, position.z), (2, 0, 0), atol=1e-12)
        assert abs(orientation.w) == pytest.approx(1.0)
        tf, _ = reader.next("/tf")
        chain = [(t.header.frame_id, t.child_frame_id) for t in tf.transforms]
        assert chain == [
            ("map", "world"), ("world", "camera_optical_frame"),
            ("camera_optical_frame", "camera_link"),
        ]  # fmt: skip
        cloud = kept["points"]
        rows = np.frombuffer(cloud.data.tobytes(), np.dtype([("xyz", "<f4", 3), ("bgr0", "u1", 4)]))
        np.testing.assert_array_equal(rows["xyz"], xyz)
        np.testing.assert_array_equal(rows["bgr0"][:, 2::-1], rgb)
        assert [pose.pose.position.z for pose in kept["path"].poses] == [0.0, 2.0]
        del subscriptions


@pytest.fixture
def ros(endpoint: str) -> Iterator[tuple[str, Node]]:
    with open_session([endpoint]) as session:
        yield endpoint, Node(session, "/driver")


class Driver:
    """Publishes images, as a driver would, to whoever subscribed."""

    def __init__(self, endpoint: str, node: Node, *, info: bool = True) -> None:
        self._messages = bags.Ros(2)
        self._frames = itertools.count()
        self._stopping = threading.Event()
        self._images = node.publisher(RosTopic.of("/cam/image_raw", "sensor_msgs/msg/Image"))
        self._infos = None
        if info:
            camera = RosTopic.of("/cam/camera_info", "sensor_msgs/msg/CameraInfo")
            self._infos = node.publisher(camera)
        wait_until_published(endpoint, "/cam/image_raw", *["/cam/camera_info"] * info)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stopping.wait(0.02):
            frame = next(self._frames)
            self._images.put(serialised_of(self._messages, self._messages.image(frame)))
            if self._infos is not None:
                info = self._messages.camera_info(frame)
                self._infos.put(serialised_of(self._messages, info))


def serialised_of(ros: bags.Ros, message: Any) -> bytes:
    return bytes(ros.store.serialize_cdr(message, message.__msgtype__))


def test_a_camera_of_ros_is_a_source(ros: tuple[str, Node]) -> None:
    endpoint, node = ros
    host = endpoint.removeprefix("tcp/")
    driver = Driver(endpoint, node)
    try:
        source = open_source(f"ros:{host}")
        assert (source.is_live, source.frame_count) == (True, None)
        assert (source.calibration.width, source.calibration.fx) == (bags.WIDTH, bags.K[0])
        frames = list(itertools.islice(source, 4))
    finally:
        driver.stop()
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    for frame in frames:
        number = (frame.stamp_ns - bags.START_NS) // bags.STEP_NS
        np.testing.assert_array_equal(decode(frame), bags.picture(number))


@pytest.mark.parametrize("ends", [False, True])
def test_sensors_are_heard_while_images_come(ros: tuple[str, Node], ends: bool) -> None:
    """A topic that has ended between the opening of the source and its images is left out."""
    endpoint, node = ros
    messages, driver = bags.Ros(2), Driver(endpoint, node)
    try:
        with open_session([endpoint]) as session:
            sensor = Node(session, "/sensor").publisher(RosTopic.of("/imu", "sensor_msgs/msg/Imu"))
            wait_until_published(endpoint, "/imu")
            source = open_source("ros:" + endpoint.removeprefix("tcp/"))
            assert isinstance(source, RosCamera)
            if ends:
                session.close()
                wait_until_published(endpoint, "/imu", gone=True)
            frames = iter(source)
            heard = list[int]()
            for number in range(30):
                next(frames)
                if not ends:
                    sensor.put(serialised_of(messages, bags.imu(messages, number)))
                heard += source.next_imu().stamps_ns.tolist()
            for _ in range(int(PATIENCE_S / 0.02)):
                if ends or len(heard) == 30:
                    break
                next(frames)
                heard += source.next_imu().stamps_ns.tolist()
    finally:
        driver.stop()
    assert source.has_imu
    assert len(heard) == (0 if ends else 30)
    assert heard == sorted(set(heard))


def test_it_ends_without_publishers(endpoint: str) -> None:
    with open_session([endpoint]) as session:
        driver = Driver(endpoint, Node(session, "/driver"))
        source = iter(
            open_source(
                SourceSpec(location="ros:" + endpoint.removeprefix("tcp/"), topic="cam/image_raw")
            )
        )
        assert next(source).index == 0
        driver.stop()
    assert all(frame.index > 0 for frame in source)


def test_what_cannot_be_had_is_one_line(
    ros: tuple[str, Node], monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoint, node = ros
    host = endpoint.removeprefix("tcp/")
    with pytest.raises(DatasetError, match="no topic with images"):
        open_source(f"ros:{host}")
    driver = Driver(endpoint, node, info=False)
    try:
        with pytest.raises(DatasetError, match=r"no topic /other; images are in /cam/image_raw"):
            open_source(SourceSpec(location=f"ros:{host}", topic="/other"))
        source = open_source(SourceSpec(location=f"ros:{host}", fov_deg=70.0))
        assert next(iter(source)).width == bags.WIDTH
    finally:
        driver.stop()
    wrong = node.publisher(RosTopic.of("/wrong/image", "sensor_msgs/msg/Image"))
    wait_until_published(endpoint, "/wrong/image")
    monkeypatch.setattr("pliant.datasets.ros_camera._FIRST_S", 0.0)
    with pytest.raises(DatasetError, match="no message arrived"):
        open_source(SourceSpec(location=f"ros:{host}", topic="/wrong/image"))
    stopping = threading.Event()

    def babble() -> None:
        while not stopping.wait(0.02):
            wrong.put(serialised(made("std_msgs/msg/String", data="x")))

    monkeypatch.setattr("pliant.datasets.ros_camera._FIRST_S", PATIENCE_S)
    thread = threading.Thread(target=babble)
    thread.start()
    try:
        with pytest.raises(DatasetError, match="its message is damaged"):
            open_source(SourceSpec(location=f"ros:{host}", topic="/wrong/image"))
    finally:
        stopping.set()
        thread.join()
    monkeypatch.setattr("pliant.bus.session.CONNECT_TIMEOUT_S", 0.3)
    with pytest.raises((DatasetError, CalibrationError), match="cannot reach tcp"):
        open_source("ros:127.0.0.1:9")
