"""One wrong time costs one frame, and every frame that did not come is counted."""

import base64
import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recorded_messages as bags
from recorded_messages import HEIGHT, START_NS, STEP_NS, WIDTH, Ros

from pliant.datasets import notes_on, open_source
from pliant.datasets.base import BrokenFrame, SourceFrame
from pliant.datasets.frame_times import in_order, increasing
from pliant.datasets.rectifier import decode
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import CalibrationError, DatasetError
from pliant.results.judgement import BAD, DOUBTFUL, GOOD, judge

COUNT = 40


def frame(index: int, stamp_ns: int) -> SourceFrame:
    return SourceFrame(
        index=index, stamp_ns=stamp_ns, encoding="mono8", data=b"1", width=1, height=1
    )


@pytest.mark.parametrize(
    ("stamps", "kept"),
    [
        ([1, 2, 3], [0, 1, 2]),
        ([1, 2, 2, 3], [0, 1, 3]),  # doubled
        ([1, 3, 2, 4], [0, 2, 3]),  # swapped
        ([5, 6, 1, 7], [0, 1, 3]),  # set back
        ([5, 900, 6, 7], [0, 2, 3]),  # far ahead
        ([900, 5, 6, 7], [1, 2, 3]),
        ([], []),
    ],
)
def test_as_many_times_as_possible_are_believed(stamps: list[int], kept: list[int]) -> None:
    assert increasing(stamps) == kept


@pytest.mark.parametrize(
    ("row", "wrong_ns"),
    [(20, 19), (20, 0), (20, 10**6), (0, 10**6), (COUNT - 1, 5), (20, 21), (1, 0)],
)
@pytest.mark.parametrize("together", [1, 3])
def test_a_wrong_time_costs_one_frame(row: int, wrong_ns: int, together: int) -> None:
    stamps = [1000 * i for i in range(COUNT)]
    rows = range(row, min(row + together, COUNT))
    for each in rows:
        stamps[each] = 1000 * wrong_ns + (each - row if wrong_ns > COUNT else 0)
    came = list(in_order(frame(i, stamp) for i, stamp in enumerate(stamps)))
    assert [f.index for f in came] == list(range(COUNT))
    assert all(b.stamp_ns > a.stamp_ns >= 0 for a, b in itertools.pairwise(came))
    broken = [f.index for f in came if not f.data]
    assert len(broken) <= together
    assert set(broken) & set(rows) or wrong_ns == 21
    for each in broken:
        with pytest.raises(BrokenFrame, match=f"frame {each}: its time, "):
            decode(came[each])


def test_a_clock_that_is_set_back_costs_what_follows_and_no_more() -> None:
    stamps = [1000 * i for i in range(COUNT)] + [1000 * i + 500 for i in range(10, COUNT)]
    came = list(in_order(frame(i, stamp) for i, stamp in enumerate(stamps)))
    assert [f.index for f in came if f.data] == [*range(COUNT), 2 * COUNT - 11]


def test_without_a_look_ahead_frames_come_at_once() -> None:
    stamps = iter([1000, 2000, 2000, 1500, 3000])
    taken: list[int] = []

    def source() -> Any:
        for index, stamp in enumerate(stamps):
            taken.append(index)
            yield frame(index, stamp)

    came = in_order(source(), ahead=False)
    assert next(came).index == 0
    assert taken == [0]
    assert [f.index for f in came if f.data] == [1, 4]


def ros2(path: Path, ros: Ros, messages: dict[str, list[Any]]) -> None:
    bags.write_ros2_bag(path, ros, messages)


WRITERS: dict[str, Callable[[Path, Ros, dict[str, list[Any]]], None]] = {
    "bag": ros2,
    "bag.mcap": bags.write_ros_mcap,
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("stamp_of_20", [19, 5, 21, 4000])
def test_a_wrong_time_in_a_bag_costs_one_frame(name: str, stamp_of_20: int, tmp_path: Path) -> None:
    ros = Ros(2)
    images = [ros.image(i) for i in range(COUNT)]
    images[20].header = ros.header(stamp_of_20)
    if stamp_of_20 == 21:  # swapped
        images[21].header = ros.header(20)
    WRITERS[name](tmp_path / name, ros, {"/image": images})
    came = list(open_source(SourceSpec(location=str(tmp_path / name), fov_deg=70.0)))
    assert len(came) == COUNT
    assert sum(not f.data for f in came) == 1
    stamps = np.array([f.stamp_ns for f in came])
    assert np.all(np.diff(stamps) > 0)
    assert abs(stamps - START_NS - STEP_NS * np.arange(COUNT)).max() <= STEP_NS


def test_an_encoding_that_is_not_understood_costs_one_frame(tmp_path: Path) -> None:
    ros = Ros(2)
    images = [ros.image(i) for i in range(COUNT)]
    images[7].encoding = "nothing"
    bags.write_ros_mcap(tmp_path / "a.mcap", ros, {"/image": images})
    came = list(open_source(SourceSpec(location=str(tmp_path / "a.mcap"), fov_deg=70.0)))
    assert [f.index for f in came if not f.data] == [7]
    with pytest.raises(BrokenFrame, match="frame 7: images with encoding 'nothing'"):
        decode(came[7])


def test_a_message_that_cannot_be_read_costs_one_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ros = Ros(2)
    short = [ros.image(i) for i in range(COUNT)]
    original, cut = ros.store.serialize_cdr, ros.header(9).stamp

    def serialise(value: Any, kind: str) -> bytes:
        data = bytes(original(value, kind))
        return data[:30] if value.header.stamp == cut else data

    monkeypatch.setattr(ros.store, "serialize_cdr", serialise)
    for name, write in WRITERS.items():
        write(tmp_path / name, ros, {"/image": short})
        came = list(open_source(SourceSpec(location=str(tmp_path / name), fov_deg=70.0)))
        assert [f.index for f in came if not f.data] == [9]
        with pytest.raises(BrokenFrame, match="frame 9: its message is damaged"):
            decode(came[9])


def test_a_source_with_fewer_images_than_announced_has_a_note(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pliant.datasets import mcap_file

    ros = Ros(2)
    bags.write_ros_mcap(tmp_path / "a.mcap", ros, bags.usual(ros))
    opened = open_source(str(tmp_path / "a.mcap"))
    original = mcap_file._OpenMcap.messages  # pyright: ignore[reportPrivateUsage]

    def fewer(self: Any, topic: Any) -> Any:
        yield from list(original(self, topic))[:2]

    monkeypatch.setattr(mcap_file._OpenMcap, "messages", fewer)  # pyright: ignore[reportPrivateUsage]
    with pytest.raises(DatasetError, match="holds 2 of the 3 images of its index"):
        list(opened)


def listed(folder: Path, times: list[str]) -> Path:
    import cv2

    folder.mkdir()
    for row in range(len(times)):
        cv2.imwrite(str(folder / f"{row}.png"), np.full((20, 20), row, np.uint8))
    lines = [f"{time} {row}.png" for row, time in enumerate(times)]
    (folder / "rgb.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("wrong", ["1.9", "0.5", "2.1", "777"])
def test_a_wrong_time_in_a_list_costs_one_frame(wrong: str, tmp_path: Path) -> None:
    times = [f"{0.1 * i:.1f}" for i in range(COUNT)]
    times[20] = wrong
    if wrong == "2.1":
        times[21] = "2.0"
    source = open_source(SourceSpec(location=str(listed(tmp_path / "a", times)), fov_deg=70.0))
    came = list(source)
    broken = [f.index for f in came if not f.data]
    assert len(broken) == 1
    assert broken[0] in (20, 21)
    assert all(b.stamp_ns > a.stamp_ns for a, b in itertools.pairwise(came))
    (note,) = notes_on(source)
    assert note.startswith("rgb.txt: the times of 1 image do not increase (the first in line 2")


def test_a_list_with_many_wrong_times_is_refused(tmp_path: Path) -> None:
    times = [f"{0.1 * (i if i < 20 else i - 20):.2f}" for i in range(COUNT)]
    with pytest.raises(DatasetError, match=r"line 21: the time .* runs back"):
        open_source(SourceSpec(location=str(listed(tmp_path / "a", times)), fov_deg=70.0))


def test_a_verdict_speaks_of_all_frames_of_the_source() -> None:
    half = judge(frames=60, in_segments=[60], doubtful=0, absent=60)
    assert half == (DOUBTFUL, "only 50% of the source's frames arrived")
    assert judge(frames=50, in_segments=[50], doubtful=0, absent=70)[0] == BAD
    few = judge(frames=115, in_segments=[115], doubtful=0, absent=5)
    assert few == (GOOD, "96% of the frames of the source have a pose in the largest segment")
    # Neither is much, both together are.
    both = judge(frames=100, in_segments=[88], doubtful=0, broken=5)
    assert both[0] == DOUBTFUL
    ended = judge(frames=60, in_segments=[60], doubtful=0, failed=True)
    assert ended == (DOUBTFUL, "the source ended early")


def write_json(path: Path, messages: list[dict[str, Any]], calibration: dict[str, Any]) -> None:
    """An MCAP file of Foxglove's types as JSON, with whatever fields."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="test")
        for topic, name, contents in (
            ("/image", "RawImage", messages),
            ("/calib", "CameraCalibration", [calibration]),
        ):
            schema = writer.register_schema(f"foxglove.{name}", "jsonschema", b"{}")
            channel = writer.register_channel(topic, "json", schema)
            for i, content in enumerate(contents):
                time_ns = START_NS + i * STEP_NS
                writer.add_message(channel, time_ns, json.dumps(content).encode(), time_ns)
        writer.finish()


@pytest.mark.parametrize(
    "changed",
    [
        {"timestamp": None}, {"timestamp": "soon"}, {"timestamp": {"sec": "x"}},
        {"timestamp": {"sec": 10**12}}, {"timestamp": {"sec": -5}}, {"width": None},
        {"width": "wide"}, {"height": 10**30}, {"data": 3}, {"data": "*"}, {"encoding": ["rgb8"]},
        {"encoding": "z" * 10**6}, {"step": {}}, {"timestamp": {}},
    ],
)  # fmt: skip
def test_json_with_odd_fields_costs_one_frame(changed: dict[str, Any], tmp_path: Path) -> None:
    data = base64.b64encode(bags.picture(0).tobytes()).decode()
    messages: list[dict[str, Any]] = []
    for i in range(COUNT):
        stamp = {"sec": (START_NS + i * STEP_NS) // 10**9, "nsec": i * STEP_NS % 10**9}
        content = {"width": WIDTH, "height": HEIGHT, "encoding": "rgb8", "step": WIDTH * 3}
        messages.append({**content, "timestamp": stamp, "data": data})
    messages[4] = {k: v for k, v in {**messages[4], **changed}.items() if v is not None}
    write_json(tmp_path / "a.mcap", messages, {})
    came = list(open_source(SourceSpec(location=str(tmp_path / "a.mcap"), fov_deg=70.0)))
    assert [f.index for f in came] == list(range(COUNT))
    broken: dict[int, str] = {}
    for each in came:
        try:
            decode(each)
        except BrokenFrame as error:
            broken[each.index] = str(error)
    assert all(len(why) < 1000 for why in broken.values())
    assert [*broken] == ([] if changed == {"timestamp": {}} else [4])
    with pytest.raises(CalibrationError, match="the calibration in /calib"):
        open_source(str(tmp_path / "a.mcap"))
