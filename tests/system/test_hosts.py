"""Sessions over several hosts, what happens to them there, and the results: those of one host."""

import signal
from pathlib import Path

import pytest
from hosts import THREE, TWO, Spread, hosts
from running import digests

pytestmark = pytest.mark.system

LONG = r"{}.*, for \d+ s"  # a wait that is told with its length


def test_a_host_that_is_cut_off_is_named_and_nothing_is_lost(
    tmp_path: Path, tiny_run: Path
) -> None:
    with hosts("camera", "edge", "rack") as three, Spread(three, tmp_path, THREE) as session:
        session.start()
        session.wait_for_frame("bundle_adjustment", 12)
        three.cut("edge")
        session.wait_for_complaint("bundle_adjustment", LONG.format("tracks/extrema from tracking"))
        rows = {line.split()[1]: line for line in session.status().splitlines()[1:]}
        assert "silent" in rows["tracking"]
        assert rows["ingest"].split()[2] == "camera"
        assert " to take camera/image, for " in rows["ingest"]
        three.join("edge")
        assert session.results() == digests(tiny_run)


def test_a_reader_is_stopped_then_the_router_dies_and_nothing_is_lost(
    tmp_path: Path, tiny_run: Path
) -> None:
    with hosts("robot", "rack") as two, Spread(two, tmp_path, TWO) as session:
        session.start()
        session.wait_for_frame("bundle_adjustment", 6)
        session.send(signal.SIGSTOP, "tracking")
        session.wait_for_complaint("bundle_adjustment", LONG.format("tracks/extrema from tracking"))
        assert "tracking" in session.wait_for_complaint("ingest", LONG.format("camera/image"))
        session.send(signal.SIGCONT, "tracking")
        session.wait_for_frame("bundle_adjustment", 16)
        session.restart_router()
        assert session.results() == digests(tiny_run)
