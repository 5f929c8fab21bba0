"""The configuration of a run: defaults for every source, a YAML file over them, then ``--set``.

Each algorithm's parameters stand beside the algorithm; this module puts them together.  Every model
is frozen and refuses unknown keys, also nested ones.
"""

import difflib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias, cast

import yaml
from pydantic import BaseModel, Field, ValidationError

from pliant.algorithms.meshing.parameters import MeshingParameters
from pliant.algorithms.parameters import Parameters
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.tracking.parameters import TrackingParameters
from pliant.errors import ConfigError, RecordingError
from pliant.wording import shortened, shown
from pliant.yaml_text import YamlError, load_yaml


class IngestParameters(Parameters):
    """How frames enter."""

    mode: Literal["auto", "lossless", "live"] = Field(
        default="auto",
        description="lossless: no frame is dropped, the slowest reader sets the pace.  live: old "
        "frames are dropped.  auto: live for a camera, lossless for other sources.",
    )
    depth: Literal["first", "all"] = Field(
        default="first",
        description="Depth maps for surfels: only the first, or those of all frames, which also "
        "create new surfels.",
    )
    longest_side_px: int = Field(
        default=0,
        ge=0,
        description="Maximum pixels along the longer side of processed and recorded images; 0: "
        "chosen by the level of detail, at most 1280.",
    )
    start_s: float = Field(
        default=0.0, ge=0.0, description="Start this many seconds after the first frame."
    )
    end_s: float = Field(
        default=0.0,
        ge=0.0,
        description="End this many seconds after the first frame; 0: at the end.",
    )
    every: int = Field(default=1, ge=1, description="Process every Nth frame.")
    sharpest: bool = Field(
        default=False, description="Choose the sharpest of each N frames, not the first."
    )
    mask_static: bool = Field(
        default=True,
        description="Detect and mask borders and overlays that never change while the scene "
        "moves.  A given mask replaces them.",
    )
    mapping_lag_s: float = Field(
        default=0.4,
        ge=0.0,
        description="Live mode: maximum backlog (s) of bundle adjustment before frames skip "
        "mapping and are only localised.",
    )
    pose_lag_s: float = Field(
        default=2.0,
        ge=0.0,
        description="Live mode: maximum backlog (s) of bundle adjustment before unmapped frames "
        "skip localisation too, and get no pose.",
    )


class BusParameters(Parameters):
    """Flow control between services."""

    window: int = Field(
        default=16,
        ge=1,
        le=4096,
        description="Maximum messages of a topic on the way to its slowest reader; bounds memory.",
    )
    window_mib: int = Field(
        default=256,
        ge=1,
        le=65536,
        description="Maximum MiB of one topic on the way; a larger message is sent alone.",
    )
    lag_messages: int = Field(
        default=128,
        ge=1,
        le=4096,
        description="Maximum messages of one topic on the way to bundle adjustment, including "
        "those that it skips in live mode; beyond, other services wait.",
    )
    lag_mib: int = Field(
        default=160, ge=1, le=65536, description="Maximum MiB of these messages; bounds memory."
    )
    patience_s: float = Field(
        default=60.0,
        ge=0.0,
        description="Seconds without a peer or the router after which a service exits.",
    )
    checkpoint_frames: int = Field(
        default=60,
        ge=1,
        description="Frames between two checkpoints of a service, if services are restarted.",
    )
    link_images: Literal["raw", "lossless", "jpeg"] = Field(
        default="raw",
        description="How the ingest sends images.  raw: fastest on one machine.  lossless: half "
        "the bytes, the same pixels.  jpeg: a fifth or less; these JPEGs are "
        "recorded.",
    )
    jpeg_quality: int = Field(
        default=90, ge=1, le=100, description="JPEG quality for bus.link_images=jpeg."
    )


class RecorderParameters(Parameters):
    """The recording."""

    sync_interval_s: float = Field(
        default=1.0,
        gt=0.0,
        le=60.0,
        description="Maximum seconds of data lost in a power cut.",
    )
    window_messages: int = Field(
        default=256,
        ge=2,
        le=65536,
        description="Maximum messages of one topic on the way to the disk.  60 frames/s for the "
        "interval of a second, as much again for a slow disk, and twice that.",
    )
    window_mib: int = Field(
        default=64,
        ge=1,
        le=65536,
        description="Maximum MiB of one topic on the way to the disk.  60 images/s of 752x480 "
        "are 21 MiB per second; half of the window triggers an early write, the rest "
        "covers it.",
    )
    images: bool = Field(
        default=True,
        description="False: a small recording without camera/source, starting with the tracks.",
    )
    clip: bool = Field(
        default=True,
        description="Record the file of a video, and its frames as numbers and checksums, if "
        "that is smaller.  False: raw frames, independent of a decoder.",
    )
    roll_mib: int = Field(
        default=0, ge=0, description="Start a new file beyond this many MiB; 0: a single file."
    )
    roll_s: float = Field(
        default=0.0, ge=0.0, description="Start a new file after this many seconds; 0: never."
    )


class Config(Parameters):
    """All parameters of a run."""

    seed: int = Field(default=0, ge=0, description="Seed of all random choices.")
    ingest: IngestParameters = IngestParameters()
    bus: BusParameters = BusParameters()
    tracking: TrackingParameters = TrackingParameters()
    bundle_adjustment: MappingParameters = MappingParameters()
    meshing: MeshingParameters = MeshingParameters()
    surfels: SurfelParameters = SurfelParameters()
    recorder: RecorderParameters = RecorderParameters()


def load_config(
    file: Path | None = None, overrides: Sequence[str] = (), *, seed: int | None = None
) -> Config:
    """Defaults, then ``file`` (YAML), then ``overrides`` such as ``"bus.window=8"``.

    Raises ConfigError for a file that cannot be read, an unknown key or an impossible value.
    """
    content = _read(file) if file is not None else {}
    for override in overrides:
        _apply(content, override)
    if seed is not None:
        content["seed"] = seed
    try:
        return Config.model_validate(_over(Config().model_dump(), content))
    except ValidationError as error:
        raise ConfigError(_explain(error, file)) from None


def config_yaml(config: Config) -> str:
    """The resolved configuration as YAML that ``load_config`` reads back unchanged."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def describe(group: BaseModel | None = None, prefix: str = "") -> list[tuple[str, str, str]]:
    """(key, default, meaning) of every parameter."""
    rows: list[tuple[str, str, str]] = []
    group = Config() if group is None else group
    for name, info in type(group).model_fields.items():
        default: Any = getattr(group, name)
        if isinstance(default, BaseModel):
            rows += describe(default, f"{prefix}{name}.")
        else:
            rows.append((prefix + name, str(default), " ".join((info.description or "").split())))
    return rows


def _read(file: Path) -> dict[str, Any]:
    try:
        content: Any = load_yaml(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{file}: cannot read the configuration: {error.strerror}") from None
    except ValueError as error:  # no YAML, or no UTF-8
        raise ConfigError(f"{file}: not YAML: {shortened(str(error), 200)}") from None
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"{file}: expected keys and values, got {type(content).__name__}")
    return content


def _apply(content: dict[str, Any], override: str) -> None:
    key, separator, text = override.partition("=")
    if not separator or not key:
        raise ConfigError(f"--set {shortened(override)}: expected KEY=VALUE, e.g. bus.window=8")
    try:
        value: Any = load_yaml(text)
    except YamlError:
        raise ConfigError(f"--set {shortened(override)}: {shown(text)} is not a value") from None
    *parents, last = key.split(".")
    level = content
    for parent in parents:
        level = level.setdefault(parent, {})
        if not isinstance(level, dict):
            where = f"--set {shortened(override)}: {shortened(parent)}"
            raise ConfigError(f"{where} is a value, not a group of keys")
    level[last] = value


def _over(defaults: dict[str, Any], content: dict[str, Any]) -> dict[str, Any]:
    """The given values over the defaults of the group, which may differ from those of its class."""
    merged = dict(defaults)
    for key, value in content.items():
        group = defaults.get(key)
        both = isinstance(group, dict) and isinstance(value, dict)
        merged[key] = _over(cast(Any, group), value) if both else value
    return merged


def _explain(error: ValidationError, file: Path | None) -> str:
    first = error.errors(include_url=False)[0]
    key = shortened(".".join(str(part) for part in first["loc"]), 120)
    where = f"{file}: " if file is not None else ""
    if first["type"] != "extra_forbidden":
        return f"{where}{key}: {first['msg']} (got {shown(first['input'])})"
    known = [name for name, _, _ in describe()]
    known += sorted({name.rpartition(".")[0] for name in known} - {""})
    near = difflib.get_close_matches(key, known, n=3)
    hint = f"did you mean {' or '.join(near)}?" if near else "`pliant config` lists the keys"
    return f"{where}unknown key {key}: {hint}"


def recorded_config(metadata: Mapping[str, Mapping[str, str]], overrides: Sequence[str]) -> Config:
    """The configuration in a recording's metadata with ``overrides`` on top.

    Parameters that this release no longer has are skipped, so that every older run can be read.
    """
    text = metadata.get("config", {}).get("yaml", "")
    try:
        content = load_yaml(text) or {}
    except YamlError:
        raise RecordingError("the configuration in the recording is damaged") from None
    if not isinstance(content, dict):
        raise RecordingError("the configuration in the recording is damaged")
    known = {name for name, _, _ in describe()}
    recorded = [setting for setting in settings_of(content) if setting.partition("=")[0] in known]
    return load_config(None, [*recorded, *overrides])


Settings: TypeAlias = Mapping[str, Any] | Sequence[str] | None
"""As a caller in Python gives them: ``{"bus.window": 8}`` or ``["bus.window=8"]``."""


def overrides_of(settings: Settings) -> list[str]:
    """Settings as ``load_config`` and ``--set`` take them.  Raises ConfigError."""
    if settings is None or isinstance(settings, Mapping):
        return list(settings_of(settings or {}))
    given: list[object] = [settings] if isinstance(settings, str) else list(settings)
    wrong = next((each for each in given if not isinstance(each, str)), None)
    if wrong is not None:
        raise ConfigError(
            f'settings: {shown(wrong)}: expected texts as "bus.window=8", or a mapping as '
            '{"bus.window": 8}'
        )
    return [str(each) for each in given]


def settings_of(content: Mapping[str, object], prefix: str = "") -> Iterator[str]:
    """``"bus.window=8"`` for ``{"bus": {"window": 8}}``, and for ``{"bus.window": 8}``."""
    for key, value in content.items():
        if isinstance(value, dict):
            yield from settings_of(value, f"{prefix}{key}.")
        else:
            flow = yaml.safe_dump(value, default_flow_style=True, width=10**9)
            yield f"{prefix}{key}={flow.removesuffix('...' + chr(10)).strip()}"
