"""The length of a result's unit: ``scale.yaml`` in its folder, and readers that apply it.

The recording is unchanged, because a replay compares its bytes.  Lengths for a result are read
through ``MetricRecording``.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import yaml

from pliant.errors import ResultError
from pliant.messages.metric import in_metres
from pliant.messages.topics import Topic
from pliant.messages.types import Header
from pliant.recording.reader import Recorded, Recording
from pliant.results.folder import SCALE_NAME
from pliant.yaml_text import load_yaml


@dataclass(frozen=True, kw_only=True)
class Scale:
    """metres_per_unit: of the recording.   sigma: its standard deviation, as a share of it.
    source: of the measurement."""

    metres_per_unit: float
    sigma: float
    source: str

    def times(self, other: "Scale") -> "Scale":
        """What ``other`` has found under this one."""
        return Scale(
            metres_per_unit=self.metres_per_unit * other.metres_per_unit,
            sigma=other.sigma,
            source=other.source,
        )

    def yaml(self) -> str:
        """What stands in the file."""
        return yaml.safe_dump(asdict(self), sort_keys=False)


def read_scale(folder: Path) -> Scale | None:
    """That of a result folder; None without.  Raises ResultError for a file that is none."""
    path = folder / SCALE_NAME
    try:
        told = load_yaml(path.read_text(encoding="utf-8"))
        found = Scale(
            metres_per_unit=float(told["metres_per_unit"]),
            sigma=float(told["sigma"]),
            source=str(told["source"]),
        )
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError):
        found = None
    if found is None or not 0.0 < found.metres_per_unit < float("inf"):
        raise ResultError(f"{path}: no valid scale: remove the file, or run `pliant scale` again")
    return found


class MetricRecording(Recording):
    """A recording whose messages are decoded in metres where their scale is known."""

    def __init__(self, path: Path, scale: Scale | None = None) -> None:
        """scale: None: what stands beside the recording.  Raises RecordingError, ResultError."""
        super().__init__(path)
        self.scale = scale or read_scale(path.parent)

    def messages(self, *topics: Topic) -> Iterator[Recorded]:
        """As of a recording."""
        for recorded in super().messages(*topics):
            if self.scale is None:
                yield recorded
            else:
                yield _Metric(**vars(recorded), metres_per_unit=self.scale.metres_per_unit)


@dataclass(frozen=True, kw_only=True)
class _Metric(Recorded):
    metres_per_unit: float

    def decode(self) -> Header:
        return in_metres(super().decode(), self.metres_per_unit)
