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

from pliant.algorithms.mapping.parameters import MappingParameters
from pliant.algorithms.meshing.parameters import MeshingParameters
from pliant.algorithms.parameters import Parameters
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.tracking.parameters import TrackingParameters
from pliant.errors import ConfigError, RecordingError
from pliant.wording import shortened, shown
from pliant.yaml_text import YamlError, load_yaml


class IngestParameters(Parameters):
    """How frames enter."""

    mode: Literal["auto", "lossless", "live"] = Field(
        default="auto",
        description="lossless: nobody drops a frame, the slowest reader sets the pace.  live: the "
        "newest frame wins.  auto: live for a camera, lossless for everything else.",
    )
    depth: Literal["first", "all"] = Field(
        default="first",
        description="Depth maps for surfels: the first one alone, or those of all frames, from "
        "which new surfels are born, too.",
    )
    longest_side_px: int = Field(
        default=0,
        ge=0,
        description="Images are worked on, and recorded, with no more pixels along their longer "
        "side; 0: as many as their details need, at most 1280.",
    )
    start_s: float = Field(
        default=0.0, ge=0.0, description="Frames are taken from so many seconds after the first on."
    )
    end_s: float = Field(
        default=0.0, ge=0.0, description="And until so many seconds after it; 0: to the end."
    )
    every: int = Field(default=1, ge=1, description="One of so many frames is taken.")
    sharpest: bool = Field(
        default=False, description="Of these, that with the finest details, not the first."
    )
    mask_static: bool = Field(
        default=True,
        description="Borders and overlays that never change while the scene moves are found in the "
        "first seconds, and masked.  A given mask replaces them.",
    )
    mapping_lag_s: float = Field(
        default=0.4,
        ge=0.0,
        description="Live mode: a frame is mapped while those that wait for bundle adjustment came "
        "less than this before it, or none of them is to be mapped; the others are only localised.",
    )
    pose_lag_s: float = Field(
        default=2.0,
        ge=0.0,
        description="Live mode: a frame that is not mapped is localised by its tracks while those "
        "that wait for bundle adjustment came less than this before it; else it gets no pose.",
    )


class BusParameters(Parameters):
    """Flow control between services."""

    window: int = Field(
        default=16,
        ge=1,
        le=4096,
        description="Messages of one topic on the way to its slowest reader; bounds memory.",
    )
    window_mib: int = Field(
        default=256,
        ge=1,
        le=65536,
        description="And no more MiB than this; a larger message goes alone.",
    )
    lag_messages: int = Field(
        default=128,
        ge=1,
        le=4096,
        description="Messages of one topic on the way to bundle adjustment, with those that it "
        "passes over in live mode; beyond, the others wait for it.",
    )
    lag_mib: int = Field(
        default=160, ge=1, le=65536, description="And no more MiB than this; bounds memory."
    )
    patience_s: float = Field(
        default=60.0,
        ge=0.0,
        description="How long a peer or the router may be away before a service gives up.",
    )
    checkpoint_frames: int = Field(
        default=60,
        ge=1,
        description="Frames between two checkpoints of a service, where services are restarted.",
    )
    link_images: Literal["raw", "lossless", "jpeg"] = Field(
        default="raw",
        description="How the ingest sends images.  raw: fastest on one machine.  lossless: half "
        "the bytes, the same pixels.  jpeg: a fifth or less; what is recorded are these JPEGs.",
    )
    jpeg_quality: int = Field(default=90, ge=1, le=100, description="Of bus.link_images=jpeg.")


class RecorderParameters(Parameters):
    """The recording."""

    sync_interval_s: float = Field(
        default=1.0,
        gt=0.0,
        le=60.0,
        description="At most this many seconds are lost in a power cut.",
    )
    window_messages: int = Field(
        default=256,
        ge=2,
        le=65536,
        description="Messages of one topic that are on the way to the disk.  Twice the rate of 60 "
        "frames/s times the interval of a second, and as much again for a slow disk.",
    )
    window_mib: int = Field(
        default=64,
        ge=1,
        le=65536,
        description="MiB of one topic on the way to the disk.  60 images/s of 752x480 are 21 MiB "
        "a second; half of the window is what starts writing early, the rest covers that.",
    )
    images: bool = Field(
        default=True,
        description="False: a small recording without camera/source, from the tracks on.",
    )
    clip: bool = Field(
        default=True,
        description="A video is recorded as its file, and its frames as numbers in it with "
        "checksums, where that is smaller.  False: raw frames, which any decoder leaves as they "
        "are.",
    )
    roll_mib: int = Field(
        default=0, ge=0, description="Begin a new file beyond so many MiB; 0 for a single file."
    )
    roll_s: float = Field(
        default=0.0, ge=0.0, description="Begin a new file after so many seconds; 0 for never."
    )


class Config(Parameters):
    """Everything that a run can be told."""

    seed: int = Field(default=0, ge=0, description="Seeds every random choice.")
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
    """What is said, over the defaults of the group: these may be others than those of its class."""
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

    Parameters that this release has no longer are passed over: all of a run can be said again.
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
