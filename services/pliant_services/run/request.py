"""The request of ``pliant run``."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pliant.datasets.source_spec import SourceSpec


@dataclass(frozen=True, kw_only=True)
class RunRequest:
    """The request of a user."""

    source: SourceSpec
    profile: str = "rigid"
    output: Path | None = None
    force: bool = False
    config_file: Path | None = None
    overrides: Sequence[str] = ()
    seed: int | None = None
    known: Path | None = None
    port: int | None = None
    view: Literal["window", "web"] | None = None
    save: Path | None = None
    poses: bool = False
    on_crash: Literal["stop", "restart"] = "stop"
    resume: bool = False
    quality: Literal["normal", "high"] = "normal"
