"""``pliant service``: run one service, here or on another machine."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pliant.errors import PliantError
from pliant_services.cli.options import Connect, TlsFolder, identity_in
from pliant_services.profiles import NAMES, PROFILES

if TYPE_CHECKING:
    from pliant.config import Config

_NAMES, _PROFILES = ", ".join(NAMES), ", ".join(PROFILES)


def service(
    name: Annotated[str, typer.Argument(help=f"One of {_NAMES}.")],
    connect: Connect,
    session: Annotated[str, typer.Option(help="Name of the session to join.")] = "default",
    profile: Annotated[str, typer.Option(help=f"Profile of the session: {_PROFILES}.")] = "points",
    config_file: Annotated[Path | None, typer.Option("--config", help="YAML file.")] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", help="KEY=VALUE overrides the file; may be repeated."),
    ] = None,
    source: Annotated[
        str, typer.Option(help="ingest: source of the frames, or its SourceSpec as JSON.")
    ] = "",
    calibration: Annotated[
        Path | None, typer.Option(help="ingest: calibration of a video or camera.")
    ] = None,
    fov: Annotated[
        float | None, typer.Option(help="ingest: horizontal field of view in degrees.")
    ] = None,
    mask: Annotated[Path | None, typer.Option(help="ingest: mask, as in `pliant run`.")] = None,
    known: Annotated[
        Path | None, typer.Option("--map", help="ingest: map of earlier sessions to extend.")
    ] = None,
    topic: Annotated[str, typer.Option(help="ingest: image topic, for a file with several.")] = "",
    imu: Annotated[str, typer.Option(help="ingest: inertial samples, as in `pliant run`.")] = "",
    gps: Annotated[str, typer.Option(help="ingest: satellite fixes, as in `pliant run`.")] = "",
    output: Annotated[Path | None, typer.Option(help="recorder: the MCAP file to write.")] = None,
    metadata: Annotated[
        Path | None, typer.Option(help="recorder: JSON of metadata records to keep.")
    ] = None,
    results: Annotated[
        bool,
        typer.Option(
            "--results", help="recorder: write the results next to the recording at the end."
        ),
    ] = False,
    patience: Annotated[
        float | None, typer.Option(help="Seconds to wait for absent peers [bus.patience_s].")
    ] = None,
    state: Annotated[
        Path | None,
        typer.Option(help="Folder of checkpoints, from which a restarted service resumes."),
    ] = None,
    tls: TlsFolder = None,
    alive: Annotated[
        Path | None, typer.Option(help="File to touch once a second, for health checks.")
    ] = None,
    fleet: Annotated[
        str, typer.Option(hidden=True, help="All services of the session, set by a launcher.")
    ] = "",
    with_launcher: Annotated[
        bool, typer.Option(hidden=True, help="End when standard input closes.")
    ] = False,
    delays_ms: Annotated[
        float, typer.Option(hidden=True, help="Delay messages randomly, for tests.")
    ] = 0.0,
) -> None:
    """Run one service until its inputs end.

    pliant service tracking --connect tcp/host:7447
    """
    from pliant.config import load_config
    from pliant_services.processes import with_depth
    from pliant_services.runtime.host import ServiceOptions, end_with_launcher, run_service
    from pliant_services.runtime.session_end import run_alone

    if with_launcher:
        end_with_launcher()

    if name not in NAMES:
        raise PliantError(f"no service {name}: choose {_NAMES}")
    if profile not in PROFILES:
        raise PliantError(f"--profile {profile}: choose {_PROFILES}")
    names = tuple(fleet.split(",")) if fleet else PROFILES[profile]
    if name not in names:
        having = ", ".join(each for each, services in PROFILES.items() if name in services)
        raise PliantError(f"--profile {profile} has no {name}: choose {having}")
    config = load_config(config_file, overrides or [])
    arguments: dict[str, Any] = {}
    if name == "ingest":
        from pliant.datasets import open_source
        from pliant.datasets.measured.found import measurements_of
        from pliant.datasets.source_spec import SourceSpec
        from pliant.recording.map_file import MapFile

        if not source:
            raise PliantError(
                "ingest needs --source, such as a folder, a video, camera:0 or built-in:room"
            )
        described = source.startswith("{")
        spec = (
            SourceSpec.parse(source)
            if described
            else SourceSpec(
                location=source,
                calibration=calibration,
                fov_deg=fov,
                topic=topic,
                mask=mask,
                imu=imu,
                gps=gps,
            )
        )
        arguments["dataset"] = open_source(
            with_depth(spec, names, config),
            config.ingest,
        )
        arguments["measured"] = measurements_of(spec, arguments["dataset"])
        arguments["known"] = None if known is None else MapFile(known)
    elif name == "recorder":
        if output is None:
            raise PliantError("recorder needs --output: the MCAP file to write")
        arguments["output"] = output
        arguments["metadata"] = _metadata(metadata, config)
    options = ServiceOptions(
        endpoints=connect,
        session=session,
        fleet=names,
        arguments=arguments,
        delays_ms=delays_ms,
        patience_s=patience,
        state=state,
        identity=identity_in(tls, name),
        alive=alive,
    )
    if with_launcher:
        run_service(name, config, options)
    else:
        raise typer.Exit(run_alone(name, config, options, results=results))


def _metadata(file: Path | None, config: "Config") -> dict[str, dict[str, str]]:
    if file is None:
        from pliant.config import config_yaml
        from pliant.results.folder import run_metadata

        return run_metadata(config_yaml(config))
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise PliantError(f"{file}: cannot read the metadata: {error}") from None
    if not isinstance(content, dict) or not all(isinstance(v, dict) for v in content.values()):
        raise PliantError(f"{file}: expected metadata records as JSON: name, then keys and values")
    return content
