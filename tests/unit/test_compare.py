"""Two recordings beside each other: what differs is told in one line, first things first."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pliant.algorithms.arrays import array_fields
from pliant.errors import RecordingError
from pliant.messages import codec, topics
from pliant.messages.types import Extrema, MapUpdate, Status
from pliant.recording.compare import Difference, compare, first_difference
from pliant.recording.reader import Recording
from pliant.recording.writer import RecordingWriter

STATUS = topics.status("tracking")


def status(frame: int, *values: float, note: str = "") -> Status:
    return Status(
        frame=frame, stamp_ns=frame, frame_id="", service="tracking", note=note,
        stages=(), seconds=np.zeros(0), counters=("a",) * len(values),
        values=np.array(values, np.float64),
    )  # fmt: skip


def recording(path: Path, messages: list[Status]) -> Recording:
    with RecordingWriter(path, {}) as writer:
        for n, message in enumerate(messages):
            data = codec.encode(message)
            writer.write(STATUS, data, sequence=n, log_time_ns=n, publish_time_ns=0)
    return Recording(path)


def differences(
    tmp_path: Path, was: list[Status], now: list[Status], **tolerances: float
) -> list[Difference]:
    a, b = recording(tmp_path / "a.mcap", was), recording(tmp_path / "b.mcap", now)
    return compare(a, b, [STATUS], tolerances)


def test_the_same_is_the_same(tmp_path: Path) -> None:
    messages = [status(n, 1.0, np.nan) for n in range(5)]
    assert differences(tmp_path, messages, messages) == []


def test_how_a_recording_holds_a_message_is_no_difference(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Recordings of earlier releases have no planes."""
    messages = [status(0, *range(1000)), status(1, 1.0)]
    a = recording(tmp_path / "a.mcap", messages)
    monkeypatch.setattr("pliant.recording.writer.in_planes", lambda _, data: data)
    b = recording(tmp_path / "b.mcap", messages)
    assert [m.data for m in a.messages()] != [m.data for m in b.messages()]
    assert compare(a, b, [STATUS]) == []


def test_counts_come_before_order_before_fields(tmp_path: Path) -> None:
    was = [status(n, 1.0) for n in range(5)]
    now = [status(0, 2.0), *(status(n + 7, 1.0) for n in range(1, 3))]
    found = differences(tmp_path, was, now)
    assert [d.kind for d in found] == ["count", "field"]
    assert found[0].first == "3 messages, was 5"
    assert differences(tmp_path, was, was[:1])[0].first == "1 message, was 5"
    found = differences(tmp_path, was, [was[0], was[2], was[1], *was[3:]])
    assert [(d.kind, d.messages) for d in found] == [("order", 2)]
    assert found[0].first == "message 1 is of frame 2, was of 1"


def test_the_first_difference_is_reported_and_the_others_counted(tmp_path: Path) -> None:
    was = [status(n, 1.0, 2.0, 3.0) for n in range(5)]
    now = [was[0], *(status(n, 1.0, 2.5, 4.0) for n in range(1, 5))]
    (found,) = differences(tmp_path, was, now)
    assert found.messages == 4
    assert found.first == "frame 1: values: [1] 2.5, was 2.0; 2 of 3 values differ, by 1 at most"


def test_a_tolerance_is_for_its_field_alone(tmp_path: Path) -> None:
    was = [status(n, 1.0, 2.0) for n in range(4)]
    now = [status(n, 1.0 + 1e-9, 2.0) for n in range(4)]
    assert differences(tmp_path, was, now, values=1e-8) == []
    assert len(differences(tmp_path, was, now, values=1e-10)) == 1
    assert len(differences(tmp_path, was, now, seconds=1.0)) == 1
    now[2] = status(2, 1.0, 2.0, note="x")
    (found,) = differences(tmp_path, was, now, values=1e-8)
    assert (found.messages, found.first) == (1, "frame 2: note: 'x', was ''")
    now[2] = status(2, np.nan, 2.0)
    (found,) = differences(tmp_path, was, now, values=1e-8)
    assert found.first.startswith("frame 2: values: [0] nan, was 1.0")


def test_a_tolerance_of_no_field_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no field valeus: choose from"):
        differences(tmp_path, [], [], valeus=1.0)


@pytest.mark.parametrize("message", [Extrema, MapUpdate, Status])
def test_every_array_field_is_compared(message: type) -> None:
    sizes: dict[str, int] = {}
    values = {"frame": 0, "stamp_ns": 0, "frame_id": ""}
    for name, kind in codec.scalars(message).items():
        values.setdefault(name, () if "tuple" in str(kind) else kind())
    for spec in array_fields(message):
        shape = [s if isinstance(s, int) else sizes.setdefault(s, 2) for s in spec.shape]
        values[spec.name] = np.zeros(shape, spec.dtype)
    was = message(**values)
    for spec in array_fields(message):
        changed = getattr(was, spec.name).copy()
        changed.reshape(-1)[-1] = 1
        now = replace(was, **{spec.name: changed})
        assert first_difference(was, now).startswith(f"{spec.name}: [")


def test_zeros_of_two_signs_and_shapes() -> None:
    was = status(0, 0.0)
    assert first_difference(was, status(0, -0.0)) == "values: the bits of a zero or a NaN"
    assert first_difference(was, status(0, 0.0, 1.0)).startswith("counters: ")
