"""Inertial samples of topics that are published now, a piece at a time."""

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from pliant.algorithms.inertial.samples import ImuSamples
from pliant.datasets.image_messages import RecordedImage
from pliant.datasets.measured.message_topics import ImuStream
from pliant.datasets.message_files import MessageTopic, recorded_image

STEP_NS = 5_000_000
BOTH = [MessageTopic("/imu", "sensor_msgs/Imu", -1)]
APART = [MessageTopic(f"/{name}", "sensor_msgs/Imu", -1) for name in ("gyro", "accel")]
G = 9.80665


def vector(values: Sequence[float]) -> SimpleNamespace:
    return SimpleNamespace(x=values[0], y=values[1], z=values[2])


def message(stamp_ns: int, gravity: float = G) -> Any:
    stamp = SimpleNamespace(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    seconds = 1e-9 * stamp_ns
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp),
        angular_velocity=vector((seconds, 0.0, 0.0)),
        linear_acceleration=vector((seconds, 0.0, gravity)),
    )


class Topics:
    """What has come of each topic and was not read."""

    path = Path("ros:robot")

    def __init__(self) -> None:
        self.topics = [*BOTH, *APART]
        self.came: dict[str, list[Any]] = {topic.name: [] for topic in self.topics}

    @contextmanager
    def open(self) -> Generator["Topics"]:
        yield self

    def messages(self, topic: MessageTopic) -> Iterator[RecordedImage]:
        new, self.came[topic.name] = self.came[topic.name], []
        for each in new:
            yield recorded_image(0, lambda _, each=each: each, b"")


def stamps_of(numbers: Sequence[int]) -> list[int]:
    return [STEP_NS * (number + 1) for number in numbers]


def taken(stream: ImuStream) -> list[int]:
    """Numbers of the next samples, whose values are those of their times."""
    samples: ImuSamples = stream.take()
    np.testing.assert_allclose(samples.gyro_rad_s[:, 0], 1e-9 * samples.stamps_ns)
    np.testing.assert_allclose(samples.accel_m_s2[:, 0], 1e-9 * samples.stamps_ns, atol=1e-9)
    np.testing.assert_allclose(samples.accel_m_s2[:, 2], G)
    return (samples.stamps_ns // STEP_NS - 1).tolist()


def test_samples_come_once_each() -> None:
    file = Topics()
    stream, found = ImuStream(file, BOTH), list[int]()
    assert taken(stream) == []
    for number in range(100):
        file.came["/imu"].append(message(*stamps_of([number])))
        if number % 7 == 0:
            found += taken(stream)
            assert found == list(range(number + 1) if number >= 20 else [])
    assert found + taken(stream) == list(range(100))
    assert taken(stream) == []


def test_a_wrong_time_costs_one_sample() -> None:
    file, far_ns = Topics(), 3_600 * 10**9
    stream, found = ImuStream(file, BOTH), list[int]()
    for number in range(90):
        came = file.came["/imu"]
        came += [message(stamp) for stamp in stamps_of([number])]
        came += [message(far_ns)] * (number == 40) + [message(STEP_NS)] * (number == 60)
        found += taken(stream)
    assert found == list(range(90))


def test_gyro_and_accelerometer_apart() -> None:
    """Accelerations are between the samples of the gyro, and come some samples later."""
    file = Topics()
    stream, found = ImuStream(file, APART), list[int]()
    for number in range(200):
        (stamp,) = stamps_of([number])
        file.came["/gyro"].append(message(stamp))
        if number >= 10:
            file.came["/accel"].append(message(stamp - 10 * STEP_NS - STEP_NS // 2))
        found += taken(stream)
        assert not found or found[-1] < number - 10
    assert found == list(range(len(found)))
    assert len(found) == 189


def test_more_samples_than_fit_in_a_message() -> None:
    file = Topics()
    stream = ImuStream(file, BOTH)
    file.came["/imu"] = [message(stamp) for stamp in stamps_of(range(10_000))]
    pieces = [taken(stream) for _ in range(4)]
    assert [len(piece) for piece in pieces] == [4096, 4096, 1808, 0]
    assert list(chain.from_iterable(pieces)) == list(range(10_000))


def test_units_are_those_of_the_first_samples() -> None:
    file = Topics()
    stream = ImuStream(file, BOTH)
    for first, gravity in ((0, 1.0), (40, 3.0)):  # g; then it is shaken
        file.came["/imu"] = [message(s, gravity) for s in stamps_of(range(first, first + 40))]
        np.testing.assert_allclose(stream.take().accel_m_s2[:, 2], G * gravity)


def test_accelerations_without_gravity_are_left_to_the_alignment() -> None:
    """It refuses them with a reason; the gyro is used meanwhile."""
    file = Topics()
    file.came["/imu"] = [message(stamp, 0.1) for stamp in stamps_of(range(40))]
    np.testing.assert_allclose(ImuStream(file, BOTH).take().accel_m_s2[:, 2], 0.1)
