"""What was said to be safe is on the disk by content and by name, whatever is cut off then."""

import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from pliant.algorithms.tracks import FrameTracks
from pliant.bus.base import Received
from pliant.bus.checkpoints import Checkpoints, Place
from pliant.bus.replay_bus import ReplayBus
from pliant.config import config_yaml, load_config
from pliant.files import make_folder
from pliant.messages import codec, topics
from pliant.messages.types import Extrema, Header, SourceImage
from pliant.recording.parts import parts_of
from pliant.recording.recover import mend, recover
from pliant.recording.writer import RecordingWriter
from pliant.results.folder import prepare, run_metadata
from pliant.results.write import write_results
from pliant_services.nodes import recorder


class Disk:
    """What a power cut leaves at least: names and sizes as they were when they were last synced."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._root = root
        self._names: dict[int, dict[str, int]] = {}
        self._sizes: dict[int, int] = {}
        self._fsync = os.fsync
        monkeypatch.setattr(os, "fsync", self._on_fsync)

    def holds(self, path: Path) -> bool:
        """Whether a file, with all that is in it, or a folder is found by its path."""
        found = path.stat()
        name = self._names.get(path.parent.stat().st_ino, {}).get(path.name)
        content = stat.S_ISDIR(found.st_mode) or self._sizes.get(found.st_ino) == found.st_size
        above = path.parent == self._root or self.holds(path.parent)
        return content and name == found.st_ino and above

    def _on_fsync(self, descriptor: int) -> None:
        self._fsync(descriptor)
        found = os.fstat(descriptor)
        if stat.S_ISDIR(found.st_mode):
            with os.scandir(descriptor) as entries:
                self._names[found.st_ino] = {entry.name: entry.inode() for entry in entries}
        else:
            self._sizes[found.st_ino] = found.st_size


@pytest.fixture
def disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(tmp_path, monkeypatch)


def image(frame: int) -> SourceImage:
    size = 200_000
    return SourceImage(
        frame=frame, stamp_ns=frame, frame_id="camera",
        encoding="mono8", width=size, height=1, data=bytes(size),
    )  # fmt: skip


class _Watched:
    """A bus that looks whether what is acknowledged is on the disk."""

    def __init__(self, bus: ReplayBus, disk: Disk, file: Path) -> None:
        self._bus, self._disk, self._file = bus, disk, file
        self.safe: list[bool] = []

    def receive_any(self, *, timeout_s: float | None = None) -> Iterator[Received | None]:
        yield from self._bus.receive_any()

    def acknowledge(self) -> None:
        self._bus.acknowledge()
        self.safe.append(all(map(self._disk.holds, parts_of(self._file))))


@pytest.mark.parametrize("roll_mib", [0, 1])
def test_a_recorder_acknowledges_what_a_power_cut_leaves(
    roll_mib: int, disk: Disk, tmp_path: Path
) -> None:
    config = load_config(None, [f"recorder.roll_mib={roll_mib}", "recorder.window_messages=6"])
    file = tmp_path / "recording.mcap"
    bus = _Watched(ReplayBus({topics.SOURCE: [image(n) for n in range(20)]}), disk, file)
    recorder.run(bus, config, file, {})
    assert len(bus.safe) >= 6
    assert all(bus.safe)


def test_what_was_recovered_replaces_what_was_damaged(disk: Disk, tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    make_folder(folder)
    part = folder / "part_00000.mcap"
    with RecordingWriter(part, {}) as writer:
        for n in range(10):
            data = codec.encode(image(n))
            writer.write(topics.SOURCE, data, sequence=n, log_time_ns=n, publish_time_ns=n)
    part.write_bytes(part.read_bytes()[:-100])
    recover(part, tmp_path / "whole.mcap")
    assert disk.holds(tmp_path / "whole.mcap")
    mend(tmp_path / "recording.mcap")
    assert disk.holds(part)


def test_results_are_those_of_a_run_as_a_whole(disk: Disk, tmp_path: Path) -> None:
    output = tmp_path / "results" / "room"
    config = config_yaml(load_config())
    prepare(output, config)
    with RecordingWriter(output / "recording.mcap", run_metadata(config)) as writer:
        data = codec.encode(
            Extrema.of(Header(frame=0, stamp_ns=0, frame_id="camera"), FrameTracks.empty())
        )
        writer.write(topics.EXTREMA, data, sequence=0, log_time_ns=1, publish_time_ns=0)
    write_results(output)
    files = [path for path in output.rglob("*") if path.is_file()]
    assert {"report.json", "trajectory.txt", "config.yaml", "metadata.json", "points.ply"} <= {
        path.name for path in files
    }
    assert [path.name for path in files if not disk.holds(path)] == []


def test_a_checkpoint_of_a_power_cut_is_reported(disk: Disk, tmp_path: Path) -> None:
    folder = tmp_path / "state" / "tracking"
    checkpoints = Checkpoints(folder, interval=1)
    told: list[bool] = []
    for frame in range(2):
        place = Place(frame, {"camera/image": frame}, {})
        checkpoints.save(
            place, b"state", lambda: told.append(all(map(disk.holds, folder.iterdir())))
        )
        checkpoints.close()
    assert told == [True, True]
    assert len(list(folder.glob("*.state"))) == 2
