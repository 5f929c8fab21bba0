"""Small bags and MCAP files, as ROS and Foxglove would write them."""

import base64
import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.writer import Writer

WIDTH, HEIGHT, COUNT = 48, 32, 3
STEP_NS = 50_000_000
START_NS = 1_700_000_000_000_000_000
K = [40.0, 0.0, 23.5, 0.0, 41.0, 15.5, 0.0, 0.0, 1.0]
P = [44.0, 0.0, 22.0, 0.0, 0.0, 44.0, 16.0, 0.0, 0.0, 0.0, 1.0, 0.0]
PLUMB_BOB = ("plumb_bob", [-0.05, 0.01, 0.001, -0.002, 0.0])


def picture(index: int) -> Any:
    """(H, W, 3) RGB pixels that differ from frame to frame."""
    return np.random.default_rng(index).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def jpeg(index: int) -> bytes:
    return cv2.imencode(".jpg", picture(index)[:, :, ::-1])[1].tobytes()


class Ros:
    """Messages of one ROS release."""

    def __init__(self, release: int) -> None:
        typesys: Any = pytest.importorskip("rosbags.typesys")
        self.one = release == 1
        self.store = typesys.get_typestore(
            typesys.Stores.ROS1_NOETIC if self.one else typesys.Stores.ROS2_HUMBLE
        )
        self.types = self.store.types

    def header(self, index: int) -> Any:
        stamp_ns = START_NS + index * STEP_NS
        time = self.types["builtin_interfaces/msg/Time"](
            sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )
        number = {"seq": index} if self.one else {}
        return self.types["std_msgs/msg/Header"](stamp=time, frame_id="camera", **number)

    def image(self, index: int, *, encoding: str = "rgb8", padding: int = 0, **more: Any) -> Any:
        pixels = more.pop("pixels", picture(index))
        rows = np.ascontiguousarray(pixels).reshape(HEIGHT, -1).view(np.uint8)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        values = {"is_bigendian": 0, **more}
        return self.types["sensor_msgs/msg/Image"](
            header=self.header(index), height=HEIGHT, width=WIDTH, encoding=encoding,
            step=rows.shape[1], data=rows.reshape(-1), **values,
        )  # fmt: skip

    def compressed(self, index: int) -> Any:
        data = np.frombuffer(jpeg(index), np.uint8)
        return self.types["sensor_msgs/msg/CompressedImage"](
            header=self.header(index), format="jpeg", data=data
        )

    def camera_info(self, index: int, distortion: tuple[str, list[float]] = PLUMB_BOB) -> Any:
        model, coefficients = distortion
        region = self.types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        name = str.upper if self.one else str.lower
        matrices = {
            name("d"): np.array(coefficients), name("k"): np.array(K),
            name("r"): np.eye(3).reshape(-1), name("p"): np.array(P),
        }  # fmt: skip
        return self.types["sensor_msgs/msg/CameraInfo"](
            header=self.header(index), height=HEIGHT, width=WIDTH, distortion_model=model,
            binning_x=0, binning_y=0, roi=region, **matrices,
        )  # fmt: skip

    def text(self) -> Any:
        return self.types["std_msgs/msg/String"](data="hello")


Messages = dict[str, list[Any]]


def usual(ros: Ros) -> Messages:
    """One camera with its calibration, and something else."""
    return {
        "/camera/image_raw": [ros.image(i) for i in range(COUNT)],
        "/camera/camera_info": [ros.camera_info(i) for i in range(COUNT)],
        "/chatter": [ros.text()],
    }


def write_ros1_bag(path: Path, ros: Ros, messages: Messages) -> None:
    rosbag1: Any = importlib.import_module("rosbags.rosbag1")
    with rosbag1.Writer(path) as writer:
        _fill(writer, ros, messages, ros.store.serialize_ros1)


def write_ros2_bag(path: Path, ros: Ros, messages: Messages) -> None:
    rosbag2: Any = importlib.import_module("rosbags.rosbag2")
    with rosbag2.Writer(path, version=9) as writer:
        _fill(writer, ros, messages, ros.store.serialize_cdr)


def _fill(writer: Any, ros: Ros, messages: Messages, serialise: Callable[..., Any]) -> None:
    for topic, values in messages.items():
        kind = values[0].__msgtype__
        connection = writer.add_connection(topic, kind, typestore=ros.store)
        for i, value in enumerate(values):
            writer.write(connection, START_NS + i * STEP_NS, serialise(value, kind))


def write_ros_mcap(path: Path, ros: Ros, messages: Messages) -> None:
    """As ``ros2 bag record --storage mcap`` and Foxglove's bridge do, or ``mcap convert`` of a
    ROS 1 bag."""
    release = 1 if ros.one else 2
    serialise = ros.store.serialize_ros1 if ros.one else ros.store.serialize_cdr
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile=f"ros{release}", library="test")
        for topic, values in messages.items():
            kind = values[0].__msgtype__
            text, _ = ros.store.generate_msgdef(kind, ros_version=release)
            name = kind.replace("/msg/", "/") if ros.one else kind
            schema = writer.register_schema(name, f"ros{release}msg", text.encode())
            channel = writer.register_channel(topic, "ros1" if ros.one else "cdr", schema)
            for i, value in enumerate(values):
                time_ns = START_NS + i * STEP_NS
                writer.add_message(channel, time_ns, bytes(serialise(value, kind)), time_ns)
        writer.finish()


def write_foxglove_mcap(path: Path, *, raw: bool, encoding: str) -> None:
    """Images and calibration in Foxglove's own types, as protobuf or JSON."""
    kind = "RawImage" if raw else "CompressedImage"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="test")
        for topic, name, count in (("/image", kind, COUNT), ("/calib", "CameraCalibration", 1)):
            schema, make = _foxglove_type(writer, name, encoding)
            channel = writer.register_channel(topic, encoding, schema)
            for i in range(count):
                time_ns = START_NS + i * STEP_NS
                writer.add_message(channel, time_ns, make(i, time_ns), time_ns)
        writer.finish()


def _foxglove_type(writer: Writer, name: str, encoding: str) -> tuple[int, Callable[..., bytes]]:
    contents: dict[str, Callable[[int], dict[str, Any]]] = {
        "RawImage": lambda i: {
            "width": WIDTH, "height": HEIGHT, "encoding": "rgb8", "step": WIDTH * 3,
            "data": picture(i).tobytes(),
        },
        "CompressedImage": lambda i: {"format": "jpeg", "data": jpeg(i)},
        "CameraCalibration": lambda _: {
            "width": WIDTH, "height": HEIGHT, "distortion_model": PLUMB_BOB[0],
            "D": PLUMB_BOB[1], "K": K, "P": P,
        },
    }  # fmt: skip
    if encoding == "json":

        def make_json(i: int, time_ns: int) -> bytes:
            content = contents[name](i)
            if "data" in content:
                content["data"] = base64.b64encode(content["data"]).decode()
            content["timestamp"] = {"sec": time_ns // 10**9, "nsec": time_ns % 10**9}
            return json.dumps(content).encode()

        return writer.register_schema(f"foxglove.{name}", "jsonschema", b"{}"), make_json
    pytest.importorskip("foxglove_schemas_protobuf")
    support: Any = pytest.importorskip("mcap_protobuf.schema")
    module: Any = importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2")

    def make(i: int, time_ns: int) -> bytes:
        message = getattr(module, name)(**contents[name](i))
        message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, 10**9)
        data = message.SerializeToString()
        assert isinstance(data, bytes)
        return data

    return support.register_schema(writer, getattr(module, name)), make


def imu(ros: Ros, index: int, turning: float = 0.5) -> Any:
    """A sample at the time of an image."""
    vector = ros.types["geometry_msgs/msg/Vector3"]
    quaternion = ros.types["geometry_msgs/msg/Quaternion"]
    unknown = np.array([-1.0, *[0.0] * 8])
    return ros.types["sensor_msgs/msg/Imu"](
        header=ros.header(index),
        orientation=quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=unknown,
        angular_velocity=vector(x=0.25 * index, y=turning, z=0.0),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(x=0.0, y=9.5, z=1.0),
        linear_acceleration_covariance=np.zeros(9),
    )
