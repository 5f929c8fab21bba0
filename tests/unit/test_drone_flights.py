"""A short flight of the kind that ``scripts/bench drone-flights`` measures."""

import numpy as np
import pytest
from benchmarks import drone_flights
from benchmarks.drone_scenes import drone_scene

from pliant.algorithms.geometry import so3_exp
from pliant.formats.tum import write_tum
from pliant.trajectory import Trajectory


def flight(frames: int) -> Trajectory:
    """Sideways in a bow through a room, nodding, at 20 images a second."""
    time = np.arange(frames) / 20.0
    T = np.tile(np.eye(4), (frames, 1, 1))
    T[:, :3, 3] = np.column_stack([0.6 * time, 0.2 * np.sin(2.0 * time), 1.5 + 0.1 * time])
    ahead = so3_exp(np.array([-np.pi / 2.0, 0.0, 0.0]))
    nod = np.column_stack([0.05 * np.sin(5.0 * time), 0.1 * np.sin(3.0 * time), 0.0 * time])
    T[:, :3, :3] = ahead @ so3_exp(nod)
    stamps_ns = np.round(1e9 * (1.0 + time)).astype(np.int64)
    return Trajectory(stamps_ns=stamps_ns, T_world_camera=T)


def test_nothing_is_flown_into():
    positions = flight(40).positions
    solids = drone_scene("V1", positions).solids
    assert len(solids) > 50
    for solid in solids[1:]:
        reach = np.linalg.norm(positions - solid.centre, axis=1)
        assert (reach > 0.5 * min(solid.size)).all()


@pytest.mark.slow
def test_a_flight_is_one_segment(tmp_path, monkeypatch):
    write_tum(tmp_path / "V1.txt", flight(24))
    small = drone_flights.CAMERA.model_copy(update={"width": 376, "height": 240})
    monkeypatch.setattr(drone_flights, "CAMERA", small)
    *_, row, summary = drone_flights.measure(tmp_path, only=[], frames=None, overrides=[])
    name, frames, *_, share, posed, segments = (cell.strip() for cell in row.split("|")[1:-1])
    assert (name, frames, posed, segments) == ("V1", "24", "100.0 %", "1")
    assert float(share.removesuffix(" %")) < 0.3
    assert summary.startswith("mean")
