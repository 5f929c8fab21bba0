"""`pliant view` and `pliant run --save`, on a machine without a display."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.system


def pliant(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pliant_services.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_a_run_is_seen_live_and_afterwards(tmp_path: Path) -> None:
    rr = pytest.importorskip("rerun")
    result, live, after = tmp_path / "tiny", tmp_path / "live.rrd", tmp_path / "after.rrd"
    done = pliant("run", "built-in:tiny", "--output", result, "--save", live)
    assert done.returncode == 0, done.stderr
    assert f"pliant view {result}" in done.stderr
    assert not (result / "session.json").exists()
    done = pliant("view", result, "--save", after)
    assert done.returncode == 0, done.stderr
    command = Path(sys.executable).with_name("rerun")
    if not command.is_file():
        pytest.skip(f"the command of rerun {rr.__version__} is not here")
    for path in (live, after):
        printed = subprocess.run([command, "rrd", "print", path], capture_output=True, text=True)
        assert printed.returncode == 0, printed.stderr
        for entity in ("camera", "camera/image", "camera/image/tracks", "points/0", "path"):
            assert f"/map/world/{entity}" in printed.stdout, f"{path.name}: {entity}"


def test_wrong_requests_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rerun")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    there = tmp_path / "there.rrd"
    there.write_text("mine")
    for arguments, says in (
        ((tmp_path / "nothing", "--save", tmp_path / "x.rrd"), "no such recording"),
        (("--save", tmp_path / "x.rrd"), "nothing to view"),
        ((tmp_path, "--save", there), "--force"),
        ((tmp_path, "--save", there, "--web"), "contradict"),
        ((tmp_path,), "there is no display"),
        (("--connect", "tcp/127.0.0.1:9", "--save", tmp_path / "x.rrd"), "--session"),
    ):
        done = pliant("view", *arguments)
        assert done.returncode == 1
        assert says in done.stderr
        assert done.stderr.count("\n") == 1, done.stderr
    assert there.read_text() == "mine"
