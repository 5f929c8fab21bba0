"""Python's interface: ground truth, settings, and formats of other packages."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pliant
from pliant import datasets
from pliant.config import overrides_of
from pliant.datasets import open_source, sources_in
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import ConfigError, DatasetError, ResultError
from pliant.formats.tum import write_tum

PLUGIN = '''
from pathlib import Path
from pliant.datasets import SourceFormat, SourceFrame
from pliant.datasets.calibration import calibration_from_fov

class Shades:
    """A file ``NAME.shades``: the grey level of each frame."""

    is_live = False
    ground_truth_path = None
    notes = ["shades are flat"]

    def __init__(self, spec):
        self.levels = [int(line) for line in Path(spec.location).read_text().split()]
        self.name = Path(spec.location).stem
        self.frame_count = len(self.levels)
        self.calibration = calibration_from_fov(32, 24, spec.fov_deg)

    def __iter__(self):
        for index, level in enumerate(self.levels):
            yield SourceFrame(
                index=index, stamp_ns=index * 10**8, encoding="mono8",
                data=bytes([level]) * (32 * 24), width=32, height=24,
            )

SHADES = SourceFormat(lambda source: source.endswith(".shades"), Shades)
NONE = 3
'''


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of packages with one that names a format, as pip would have installed it."""
    site = tmp_path / "site"
    info = site / "shades-1.0.dist-info"
    info.mkdir(parents=True)
    (site / "shades_plugin.py").write_text(PLUGIN)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: shades\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[pliant.sources]\nshades = shades_plugin:SHADES\n")
    monkeypatch.syspath_prepend(str(site))
    datasets.formats.cache_clear()
    yield info / "entry_points.txt"
    datasets.formats.cache_clear()


def test_a_package_brings_a_format_along(plugin: Path, tmp_path: Path) -> None:
    assert next(iter(datasets.formats())) == "shades"
    clips = tmp_path / "clips"
    clips.mkdir()
    (clips / "a.shades").write_text("3 4 5")
    source = open_source(SourceSpec(location=str(clips / "a.shades"), fov_deg=70.0))
    assert [frame.data[0] for frame in source] == [3, 4, 5]
    assert datasets.notes_on(source) == ["shades are flat"]
    assert sources_in(clips, but=tmp_path / "results") == [clips / "a.shades"]


@pytest.mark.parametrize(
    ("named", "says"),
    [
        ("shades_plugin:NONE", r"is 3: expected a pliant.datasets.SourceFormat"),
        ("shades_plugin:MISSING", r"does not load: AttributeError"),
        ("no_such_module_here:X", r"does not load: ModuleNotFoundError"),
    ],
)
def test_a_format_that_is_none_is_one_line(
    named: str, says: str, plugin: Path, tmp_path: Path
) -> None:
    plugin.write_text(f"[pliant.sources]\nshades = {named}\n")
    with pytest.raises(DatasetError, match=says) as caught:
        open_source(str(tmp_path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (None, []),
        ({}, []),
        ({"tracking.max_tracks": 2000}, ["tracking.max_tracks=2000"]),
        ({"tracking": {"max_tracks": 2000}}, ["tracking.max_tracks=2000"]),
        (["tracking.max_tracks=2000"], ["tracking.max_tracks=2000"]),
        (("a=1", "b=2"), ["a=1", "b=2"]),
        ("tracking.max_tracks=2000", ["tracking.max_tracks=2000"]),
    ],
)
def test_settings_have_two_forms(settings: Any, expected: list[str]) -> None:
    assert overrides_of(settings) == expected


def test_settings_that_are_none_are_one_line() -> None:
    with pytest.raises(ConfigError, match="settings: 3: expected texts"):
        overrides_of([3])  # type: ignore[list-item]
    with pytest.raises(ConfigError, match="unknown key"):
        pliant.Slam(settings=["tracking.max_trakcs=5"])
    assert pliant.Slam(fov=60.0, settings=["tracking.max_tracks=500"])


def walk(count: int = 60) -> pliant.Trajectory:
    t = np.arange(count) / 30.0
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, 3] = np.stack([np.sin(t), np.cos(2.0 * t), 0.3 * t], axis=1)
    return pliant.Trajectory(stamps_ns=np.rint(1e9 * t).astype(np.int64), T_world_camera=T)


def test_ground_truth_is_read_and_compared(tmp_path: Path) -> None:
    truth = walk()
    write_tum(tmp_path / "groundtruth.txt", truth)
    text = (tmp_path / "groundtruth.txt").read_text()
    (tmp_path / "windows.txt").write_text(text, encoding="utf-16")
    for path in (tmp_path, tmp_path / "groundtruth.txt", str(tmp_path), tmp_path / "windows.txt"):
        read = pliant.read_trajectory(path)
        np.testing.assert_allclose(read.positions, truth.positions, atol=1e-6)
    found = pliant.Trajectory(stamps_ns=truth.stamps_ns, T_world_camera=truth.T_world_camera.copy())
    found.T_world_camera[:, :3, 3] *= 0.5
    write_tum(tmp_path / "poses.txt", found)
    for result in (found, tmp_path / "poses.txt"):
        for against in (truth, tmp_path, str(tmp_path / "groundtruth.txt")):
            evaluation = pliant.evaluate(result, against, frames=60)
            assert evaluation.final.ate_m is not None
            assert evaluation.final.ate_m.rmse < 1e-5
            assert evaluation.final.success_rate == 1.0
            assert evaluation.better is None
    late = pliant.evaluate(found, truth, offset="3f")
    assert late.offset_s == pytest.approx(0.1, abs=1e-3)
    assert late.better is not None
    assert late.better.seconds == pytest.approx(-0.1, abs=2e-3)
    with pytest.raises(ResultError):
        pliant.read_trajectory(tmp_path / "none.txt")


def test_the_ground_truth_of_a_euroc_folder_is_found(tmp_path: Path) -> None:
    folder = tmp_path / "V1_01" / "mav0" / "state_groundtruth_estimate0"
    folder.mkdir(parents=True)
    rows = [f"{10**18 + i * 10**7}, {0.1 * i}, 0, {i % 3}, 1, 0, 0, 0" for i in range(5)]
    (folder / "data.csv").write_text("\n".join(["#timestamp, x, y, z, qw, qx, qy, qz", *rows]))
    assert len(pliant.read_trajectory(tmp_path / "V1_01")) == 5


def test_quiet_prints_nothing_but_errors(capsys: pytest.CaptureFixture[str]) -> None:
    from pliant_services.cli.options import silence

    with silence():
        print("nothing")
    assert capsys.readouterr() == ("", "")
    with pytest.raises(ConfigError), silence():
        raise ConfigError("is raised")
