"""ROS 2 on both sides of a run: a camera that is published is its source, and `pliant ros` hands
on what comes of it.  No ROS: plain sessions of Zenoh speak rmw_zenoh's keys."""

import itertools
import json
import queue
import subprocess
import threading
from collections import defaultdict
from pathlib import Path
from typing import Any

import cv2
import pytest
import zenoh
from running import UP, assert_one_line, command, in_this_process, running

from pliant.bus.session import free_endpoint, open_router, open_session
from pliant.datasets import decode, open_source
from pliant.messages import topics
from pliant.recording.measured import fixes_of, imu_of
from pliant.recording.reader import Recording

typesys: Any = pytest.importorskip("rosbags.typesys")

from pliant.ros.definitions import header, made, serialised  # noqa: E402
from pliant.ros.graph import Node, RosTopic  # noqa: E402

pytestmark = pytest.mark.system

IMAGE, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
IMU, FIX = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
PATIENCE_S = 120.0
STEP_NS = 33_333_333


def image_and_info(frame: Any, stamp_ns: int, camera: Any) -> tuple[bytes, bytes]:
    pixels = decode(frame)
    height, width = pixels.shape[:2]
    stamped = header(stamp_ns, "cam")
    image = made(
        IMAGE, header=stamped, height=height, width=width, step=pixels.strides[0],
        encoding="mono8" if pixels.ndim == 2 else "rgb8", data=pixels.ravel(),
    )  # fmt: skip
    info = made(
        INFO, header=stamped, height=height, width=width, distortion_model="plumb_bob",
        d=[0.0] * 5, k=[camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0],
    )  # fmt: skip
    return serialised(image), serialised(info)


class Driver:
    """A camera that is published as long as this is there, at first one image again and again."""

    def __init__(self, session: zenoh.Session, first: tuple[bytes, bytes]) -> None:
        node = Node(session, "/driver")
        self._image = node.publisher(RosTopic.of("/cam/image_raw", IMAGE))
        self._info = node.publisher(RosTopic.of("/cam/camera_info", INFO))
        self._imu = node.publisher(RosTopic.of("/imu", IMU), keeps_all=True)
        self._fix = node.publisher(RosTopic.of("/fix", FIX), keeps_all=True)
        self._moving = threading.Event()
        self._thread = threading.Thread(target=self._stand, args=(first,))
        self._thread.start()

    def publish(self, image: bytes, info: bytes) -> None:
        self._info.put(info)
        self._image.put(image)

    def measure(self, stamp_ns: int) -> None:
        stamped = header(stamp_ns, "imu")
        turning, forced = {"x": 0.1, "y": 0.2, "z": 0.3}, {"z": 9.81}
        self._imu.put(
            serialised(
                made(IMU, header=stamped, angular_velocity=turning, linear_acceleration=forced)
            )
        )
        self._fix.put(serialised(made(FIX, header=stamped, latitude=47.0, longitude=8.0)))

    def move(self) -> None:
        """From now on only what is published."""
        self._moving.set()
        self._thread.join()

    def _stand(self, first: tuple[bytes, bytes]) -> None:
        while not self._moving.wait(0.1):
            self.publish(*first)


class Watcher:
    """What `pliant ros` publishes, by topic, read by definitions of another release."""

    def __init__(self, session: zenoh.Session) -> None:
        self.seen: defaultdict[str, list[Any]] = defaultdict(list)
        self.images: queue.Queue[Any] = queue.Queue()
        self._store = typesys.get_typestore(typesys.Stores.ROS2_KILTED)
        self._held = [session.declare_subscriber(f"0/{n}/**", self._take) for n in ("pliant", "tf")]

    def _take(self, sample: zenoh.Sample) -> None:
        *name, kind, _ = str(sample.key_expr).split("/")[1:]
        ros = kind.replace("::msg::dds_::", "/msg/").removesuffix("_")
        message = self._store.deserialize_cdr(sample.payload.to_bytes(), ros)
        self.seen["/".join(name)].append(message)
        if name[-1] == "compressed":
            self.images.put(message)


@pytest.mark.slow
def test_a_camera_of_ros_is_mapped_and_published_in_ros(tmp_path: Path) -> None:
    endpoint, result = free_endpoint(), tmp_path / "result"
    source = "ros:" + endpoint.removeprefix("tcp/")
    tiny = open_source("built-in:tiny")
    frames = list(tiny)
    router = open_router(endpoint)
    with open_session([endpoint]) as watching:
        watcher = Watcher(watching)
        with running(source, "--topic", "cam/image_raw", "--mode", "lossless", "-o", result) as run:
            with open_session([endpoint]) as session:  # the source ends with it
                driver = Driver(session, image_and_info(frames[0], 1, tiny.calibration))
                try:
                    run.wait_for(UP)
                finally:
                    driver.move()
                ros = subprocess.Popen(
                    command("ros", result, "--router", endpoint), stderr=subprocess.PIPE, text=True
                )
                publish_all(driver, frames, tiny.calibration, watcher.images)
            code, _, errors = run.finish()
            said = ros.communicate(timeout=PATIENCE_S)[1]
    router.close()
    assert code == 0, errors
    assert ros.returncode == 0, said
    report = json.loads((result / "report.json").read_text())
    assert (report["source"], report["complete"]) == (source, True)
    assert report["frames"] >= tiny.frame_count  # of the camera that stands still none may come
    recording = Recording(result / "recording.mcap")
    samples = imu_of(recording)
    assert len(samples.stamps_ns) >= tiny.frame_count
    assert len(fixes_of(recording).stamps_ns) >= tiny.frame_count
    assert samples.gyro_rad_s[-1].tolist() == [0.1, 0.2, 0.3]
    pieces = [piece.frame for piece in recording.decoded(topics.IMU)]
    assert pieces[: report["frames"]] == list(range(report["frames"]))
    done = in_this_process("replay", recording.path, "--check", "-o", tmp_path / "again")
    assert done.returncode == 0, done.stdout + done.stderr
    seen = watcher.seen
    assert {p.header.frame_id for p in seen["pliant/pose"]} == {"map"}
    positions = [(p.pose.position.x, p.pose.position.y) for p in seen["pliant/pose"]]
    assert len(set(positions)) > 1
    assert [t.child_frame_id for t in seen["tf"][0].transforms][-1] == "camera_link"
    infos_seen = seen["pliant/camera/camera_info"]
    assert {(info.width, info.height) for info in infos_seen} == {(320, 240)}
    assert max(cloud.width for cloud in seen["pliant/points"]) > 100
    assert max(len(path.poses) for path in seen["pliant/path"]) > 1
    assert max(len(marker.points) for marker in seen["pliant/mesh"]) > 100


def publish_all(driver: Driver, frames: list[Any], camera: Any, images: "queue.Queue[Any]") -> None:
    """One after the other, each as often as it takes to come back, with a later stamp."""
    stamps = itertools.count(STEP_NS, STEP_NS)
    for frame in frames:
        for _ in range(int(PATIENCE_S)):
            stamp = next(stamps)
            driver.measure(stamp)
            driver.publish(*image_and_info(frame, stamp, camera))
            try:
                picture = cv2.imdecode(images.get(timeout=1.0).data, cv2.IMREAD_UNCHANGED)
            except queue.Empty:
                continue
            assert picture.shape[:2] == (240, 320)
            break
        else:
            raise AssertionError("no image came back")


def test_wrong_requests_are_one_line(tmp_path: Path) -> None:
    for arguments, says in (
        ((), "no session given"),
        ((tmp_path,), "no active run in this folder"),
        (("--connect", "tcp/127.0.0.1:9"), "--session"),
        (("--connect", "tcp/127.0.0.1:9", "--session", "a", "--name", "my robot"), "not a name"),
        (("--connect", "tcp/127.0.0.1:9", "--session", "a", "--router", "x"), "not an endpoint"),
    ):
        assert_one_line(in_this_process("ros", *arguments), says)
