"""``pliant run``: the whole pipeline on one source."""

from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from pliant_services.cli.options import silence

# The headings of the help page, in this order.
_everyday = partial(typer.Option, rich_help_panel="Everyday options")
_source = partial(typer.Option, rich_help_panel="The source")
_maps = partial(typer.Option, rich_help_panel="Maps of earlier runs")
_deforming = partial(typer.Option, rich_help_panel="Scenes that deform")
_recording = partial(typer.Option, rich_help_panel="The recording")
_settings = partial(typer.Option, rich_help_panel="Settings")
_faults = partial(typer.Option, rich_help_panel="Faults and network")

_LIGHT = "tracking.max_tracks=2000"
"""Costs and savings: docs/results.md, Fewer tracks."""


def run(
    source: Annotated[
        str,
        typer.Argument(
            help="Folder, video, bag, MCAP file, camera:0, ros:HOST or built-in:room.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path | None, _everyday("--output", "-o", help="Result folder [results/<source>].")
    ] = None,
    force: Annotated[
        bool, _everyday("--force", help="Overwrite the results in an existing folder.")
    ] = False,
    calibration: Annotated[
        Path | None, _everyday(help="Calibration file for a video, a camera or images.")
    ] = None,
    fov: Annotated[
        float | None,
        _everyday(help="Horizontal field of view in degrees, if there is no calibration."),
    ] = None,
    mask: Annotated[
        Path | None,
        _everyday(
            help="Mask image: black parts are ignored in all frames; or a folder with a mask per "
            "frame."
        ),
    ] = None,
    auto_mask: Annotated[
        bool,
        _everyday(
            "--auto-mask/--no-auto-mask",
            help="Without --mask, mask borders and overlays that never change.",
        ),
    ] = True,
    start: Annotated[
        float | None, _everyday(min=0.0, help="Start this many seconds after the first frame.")
    ] = None,
    end: Annotated[
        float | None, _everyday(min=0.0, help="End this many seconds after the first frame.")
    ] = None,
    every: Annotated[int | None, _everyday(min=1, help="Process every Nth frame [1].")] = None,
    sharpest: Annotated[
        bool,
        _everyday(
            "--sharpest", help="With --every: choose the sharpest of each N frames, not the first."
        ),
    ] = False,
    poses: Annotated[
        bool,
        _everyday(
            "--poses",
            help="Print each online pose: pose FRAME SECONDS tx ty tz qx qy qz qw.",
        ),
    ] = False,
    light: Annotated[
        bool,
        _everyday(
            "--light",
            help="Use a fifth of the tracks: less CPU, larger errors. For slow computers.",
        ),
    ] = False,
    quality: Annotated[
        Literal["normal", "high"],
        _everyday(
            help="high: read the source a second time, backwards, where the camera was lost."
        ),
    ] = "normal",
    view: Annotated[
        Literal["window", "web"] | None, _everyday(help="Watch live in Rerun (see pliant view).")
    ] = None,
    quiet: Annotated[
        bool, _everyday("--quiet", "-q", help="Print errors only; the exit code reports success.")
    ] = False,
    topic: Annotated[
        str, _source(help="Image topic, for an MCAP file, bag or ros:HOST with several.")
    ] = "",
    imu: Annotated[
        str,
        _source(
            help="File of inertial samples, or their topic in a bag [those that come with the "
            "source]."
        ),
    ] = "",
    gps: Annotated[
        str,
        _source(
            help="File of satellite fixes, or their topic in a bag [those that come with the "
            "source]."
        ),
    ] = "",
    max_size: Annotated[
        int | None,
        _source(
            min=1, help="Maximum pixels along the longer side [chosen by the level of detail]."
        ),
    ] = None,
    mode: Annotated[
        Literal["lossless", "live"] | None,
        _source(help="Process every frame, or drop old ones [live for a camera]."),
    ] = None,
    known: Annotated[
        Path | None,
        _maps("--map", help="Extend the map of an earlier run: its folder or map.pliant."),
    ] = None,
    localise: Annotated[
        bool, _maps("--localise", help="Only localise in that map; do not extend it.")
    ] = False,
    profile: Annotated[
        Literal["rigid", "deformable"],
        _deforming(help="Map a rigid scene, or track surfels on a deforming surface."),
    ] = "rigid",
    camera: Annotated[
        Literal["static", "moving"] | None,
        _deforming(help="deformable: whether the camera is static [surfels.camera]."),
    ] = None,
    depth: Annotated[
        Literal["sensor", "map", "flat"] | None,
        _deforming(
            help="deformable: initial depth of surfels: depth maps of the source, Pliant's own "
            "map of an initially static scene, or a plane [surfels.depth_from]."
        ),
    ] = None,
    depth_frames: Annotated[
        Literal["first", "all"] | None,
        _deforming(help="deformable: which depth maps to use [ingest.depth]."),
    ] = None,
    images: Annotated[bool, _recording("--images/--no-images", help="Record the images.")] = True,
    save: Annotated[
        Path | None, _recording(help="Save the viewer's data as a Rerun file (.rrd).")
    ] = None,
    config_file: Annotated[
        Path | None, _settings("--config", help="YAML file that overrides the defaults.")
    ] = None,
    overrides: Annotated[
        list[str] | None, _settings("--set", help="KEY=VALUE overrides the file; may be repeated.")
    ] = None,
    seed: Annotated[int | None, _settings(help="Seed of all random choices.")] = None,
    on_crash: Annotated[
        Literal["stop", "restart"],
        _faults(help="What to do when a service dies: end the run, or restart the service."),
    ] = "stop",
    resume: Annotated[
        bool,
        _faults(
            "--resume",
            help="Resume an interrupted run (power cut, kill) that used --on-crash restart.",
        ),
    ] = False,
    port: Annotated[
        int | None, _faults(min=1, max=65535, help="Port of the router [a free one].")
    ] = None,
) -> None:
    """Track, map and record a video; write trajectory, points and report.

    pliant run built-in:room

    pliant run path/to/sequence --output results/kitchen --force

    pliant run video.mp4 --calibration calib.yaml

    pliant run drive.bag --topic /camera/image_raw

    pliant run video.mp4 --fov 70 --set tracking.max_tracks=5000

    pliant run video.mp4 --start 10 --end 40 --every 5 --sharpest

    pliant run dashcam.mp4 --mask bonnet.png

    pliant run handheld.mp4 --quality high

    pliant run today.mp4 --calibration calib.yaml --map results/yesterday

    pliant run camera:0 --calibration calib.yaml --map results/office --localise --light

    pliant run path/to/cloth --profile deformable --camera static

    pliant run path/to/tissue --profile deformable --camera moving --depth map
    """
    from pliant_services.profiles import PROFILES
    from pliant_services.runtime.fork_server import server_for

    sets = [_LIGHT] if light else []
    sets += [*(overrides or []), *([f"ingest.mode={mode}"] if mode else [])]
    if profile == "rigid" and (camera or depth_frames or depth):
        raise typer.BadParameter("--camera, --depth and --depth-frames need --profile deformable")
    if light and profile != "rigid":
        raise typer.BadParameter("--light needs --profile rigid: it reduces tracks, not surfels")
    if sharpest and not every:
        raise typer.BadParameter("--sharpest needs --every N: the number of frames to choose from")
    part = {"start_s": start, "end_s": end, "every": every, "longest_side_px": max_size}
    sets += [f"ingest.{name}={value}" for name, value in part.items() if value is not None]
    sets += [] if auto_mask else ["ingest.mask_static=false"]
    sets += ["ingest.sharpest=true"] if sharpest else []
    sets += [f"surfels.camera={camera}"] if camera else []
    sets += [f"surfels.depth_from={depth}"] if depth else []
    sets += [f"ingest.depth={depth_frames}"] if depth_frames else []
    if resume and poses:
        raise typer.BadParameter("--poses needs a run from its start: leave out --resume")
    if localise and known is None:
        raise typer.BadParameter("--localise needs --map: a result folder or its map.pliant")
    if quality == "high" and (localise or profile != "rigid"):
        raise typer.BadParameter("--quality high needs --profile rigid, without --localise")
    if known is not None and profile != "rigid":
        raise typer.BadParameter("--map needs --profile rigid: a deformable run has no map")
    # A map that does not grow has no new surface.
    localising = ["bundle_adjustment.only_localise=true", "meshing.enabled=false"]
    sets += localising if localise else []
    sets += [] if images else ["recorder.images=false"]
    if quiet and (poses or view):
        raise typer.BadParameter("--quiet prints nothing: leave out --quiet, or --poses and --view")
    with silence() if quiet else nullcontext(), server_for(PROFILES[profile]) as server:
        from pliant.datasets.source_spec import SourceSpec  # the server imports at the same time
        from pliant_services.run.command import RunRequest, run_pipeline

        spec = SourceSpec(
            location=source,
            calibration=calibration,
            fov_deg=fov,
            topic=topic,
            mask=mask,
            imu=imu,
            gps=gps,
        )
        request = RunRequest(
            source=spec,
            profile=profile,
            output=output,
            force=force,
            config_file=config_file,
            overrides=sets,
            seed=seed,
            known=known,
            view=view,
            save=save,
            poses=poses,
            port=port,
            on_crash=on_crash,
            resume=resume,
            quality=quality,
        )
        code = run_pipeline(request, server)
    raise typer.Exit(code)
