"""Camera paths of the built-in scenes."""

import numpy as np
import pytest

from pliant.algorithms.geometry import so3_log
from pliant.datasets.builtin import parse_builtin
from pliant.datasets.builtin_rigid import SequenceOptions, rigid_plan


@pytest.mark.parametrize(("turn", "axis"), [("pitch", 0), ("yaw", 1), ("roll", 2)])
def test_a_full_turn_on_the_spot_and_then_the_path_continues(turn, axis):
    name, options = parse_builtin(f"built-in:tiny?turn={turn}")
    assert isinstance(options, SequenceOptions)
    plain, turned = rigid_plan(name, SequenceOptions()), rigid_plan(name, options)
    extra = len(turned.stamps_ns) - len(plain.stamps_ns)
    times = np.array(turned.stamps_ns) * 1e-9
    poses = np.array([turned.path.T_world_camera(time) for time in times])
    still = len(plain.stamps_ns) // 4
    spot = poses[still + 1 : still + extra]
    assert np.ptp(spot[:, :3, 3], axis=0).max() < 1e-12
    steps = so3_log(np.swapaxes(spot[:-1, :3, :3], 1, 2) @ spot[1:, :3, :3])
    assert np.degrees(steps[:, axis].sum()) == pytest.approx(360.0, abs=0.1)
    assert np.abs(np.delete(steps, axis, axis=1)).max() < 1e-9
    for k in (0, still, len(plain.stamps_ns) - 1):
        before = plain.path.T_world_camera(plain.stamps_ns[k] * 1e-9)
        after = poses[k if k <= still else k + extra]
        np.testing.assert_allclose(after, before, atol=1e-6)
