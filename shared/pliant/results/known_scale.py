"""Unit and vertical of a result's map: ``scale.yaml`` in its folder, and readers that apply it.

The recording is unchanged, because a replay compares its bytes.  A result gets its lengths
through ``MetricRecording``.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import quat_from_rotation, rotation_from_quat
from pliant.errors import ResultError
from pliant.messages.metric import MetricWorld, in_metres
from pliant.messages.topics import Topic
from pliant.messages.types import Header
from pliant.recording.reader import Recorded, Recording
from pliant.results.folder import SCALE_NAME
from pliant.yaml_text import load_yaml


@dataclass(frozen=True, kw_only=True)
class Level:
    """rotation_xyzw: unit quaternion of the rotation by which z points against gravity.
    sigma_deg: standard deviation of that direction."""

    rotation_xyzw: tuple[float, float, float, float]
    sigma_deg: float

    @property
    def R(self) -> F64:
        """(3, 3)."""
        return rotation_from_quat(np.array(self.rotation_xyzw))


@dataclass(frozen=True, kw_only=True)
class Scale:
    """metres_per_unit: of the recording.   sigma: its standard deviation, as a share of it.
    source: of the measurement.   level: None where gravity is unknown."""

    metres_per_unit: float
    sigma: float
    source: str
    level: Level | None = None

    def times(self, other: "Scale") -> "Scale":
        """Return the product with ``other``, which was estimated in the units of this one."""
        level = other.level or self.level
        if self.level is not None and other.level is not None:
            level = level_of(other.level.R @ self.level.R, other.level.sigma_deg)
        return Scale(
            metres_per_unit=self.metres_per_unit * other.metres_per_unit,
            sigma=other.sigma,
            source=other.source,
            level=level,
        )

    @property
    def world(self) -> MetricWorld:
        """The transform that brings a recording to metres."""
        if self.level is None:
            return MetricWorld(metres_per_unit=self.metres_per_unit)
        return MetricWorld(metres_per_unit=self.metres_per_unit, R=self.level.R, z_is_up=True)

    def content(self) -> dict[str, Any]:
        """As numbers and text, for files."""
        content: dict[str, Any] = {
            "metres_per_unit": self.metres_per_unit,
            "sigma": self.sigma,
            "source": self.source,
        }
        if self.level is not None:
            content["level"] = {
                "rotation_xyzw": list(self.level.rotation_xyzw),
                "sigma_deg": self.level.sigma_deg,
            }
        return content

    def yaml(self) -> str:
        """The content of the file."""
        return yaml.safe_dump(self.content(), sort_keys=False)


UNSCALED = Scale(metres_per_unit=1.0, sigma=0.0, source="")
"""The unit and the axes of the recording, whatever the folder has."""


def level_of(R: F64, sigma_deg: float) -> Level:
    """From the rotation (3, 3)."""
    x, y, z, w = quat_from_rotation(R).tolist()
    return Level(rotation_xyzw=(x, y, z, w), sigma_deg=sigma_deg)


def read_scale(folder: Path) -> Scale | None:
    """The scale of a result folder, or None.  Raises ResultError for an invalid file."""
    path = folder / SCALE_NAME
    try:
        content = load_yaml(path.read_text(encoding="utf-8"))
        found = Scale(
            metres_per_unit=float(content["metres_per_unit"]),
            sigma=float(content["sigma"]),
            source=str(content["source"]),
            level=_read_level(content.get("level")),
        )
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        found = None
    if found is None or not 0.0 < found.metres_per_unit < float("inf"):
        raise ResultError(f"{path}: no valid scale: remove the file, or run `pliant scale` again")
    return found


def _read_level(content: Any) -> Level | None:
    """Raises ValueError, KeyError or TypeError."""
    if content is None:
        return None
    x, y, z, w = (float(value) for value in content["rotation_xyzw"])
    if not abs(np.linalg.norm([x, y, z, w]) - 1.0) < 1e-3:
        raise ValueError("no unit quaternion")
    return Level(rotation_xyzw=(x, y, z, w), sigma_deg=float(content["sigma_deg"]))


class MetricRecording(Recording):
    """A recording whose messages are decoded in metres, and with z up, where these are known."""

    def __init__(self, path: Path, scale: Scale | None = None) -> None:
        """scale: None: that beside the recording.  Raises RecordingError, ResultError."""
        super().__init__(path)
        self.scale = scale or read_scale(path.parent)

    def messages(self, *topics: Topic) -> Iterator[Recorded]:
        """As of a recording."""
        world = None if self.scale is None else self.scale.world
        for recorded in super().messages(*topics):
            if world is None:
                yield recorded
            else:
                yield _Metric(**vars(recorded), world=world)


@dataclass(frozen=True, kw_only=True)
class _Metric(Recorded):
    world: MetricWorld

    def decode(self) -> Header:
        return in_metres(super().decode(), self.world)
