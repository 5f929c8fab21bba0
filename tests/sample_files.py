"""Files of inertial samples, for tests."""

from pathlib import Path

import numpy as np

from pliant.algorithms.inertial.samples import ImuSamples


def write_imu_csv(path: Path, samples: ImuSamples) -> Path:
    """As of EuRoC's data.csv, with a heading that names the units."""
    lines = [
        "timestamp [ns],w_x [rad/s],w_y [rad/s],w_z [rad/s],a_x [m/s^2],a_y [m/s^2],a_z [m/s^2]"
    ]
    rows = np.column_stack([samples.gyro_rad_s, samples.accel_m_s2]).tolist()
    for stamp, row in zip(samples.stamps_ns.tolist(), rows, strict=True):
        lines.append(",".join([str(stamp), *map(repr, row)]))
    path.write_text("\n".join(lines) + "\n")
    return path
