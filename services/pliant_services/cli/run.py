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
"""What that costs and saves: docs/results.md, Fewer tracks."""


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
    force: Annotated[bool, _everyday("--force", help="Write into an existing folder.")] = False,
    calibration: Annotated[
        Path | None, _everyday(help="Calibration of a video, a camera or bare images.")
    ] = None,
    fov: Annotated[
        float | None, _everyday(help="Horizontal field of view in degrees, for a first try.")
    ] = None,
    mask: Annotated[
        Path | None,
        _everyday(help="Image whose black parts are ignored in all frames, or a folder of them."),
    ] = None,
    auto_mask: Annotated[
        bool,
        _everyday(
            "--auto-mask/--no-auto-mask",
            help="Mask borders and overlays that never change, without --mask.",
        ),
    ] = True,
    start: Annotated[
        float | None, _everyday(min=0.0, help="Begin so many seconds after the first frame.")
    ] = None,
    end: Annotated[
        float | None, _everyday(min=0.0, help="End so many seconds after the first frame.")
    ] = None,
    every: Annotated[int | None, _everyday(min=1, help="Take one of so many frames [1].")] = None,
    sharpest: Annotated[
        bool, _everyday("--sharpest", help="With --every: the sharpest of them, not the first.")
    ] = False,
    poses: Annotated[
        bool,
        _everyday(
            "--poses",
            help="Print each pose as it is known: pose FRAME SECONDS tx ty tz qx qy qz qw.",
        ),
    ] = False,
    light: Annotated[
        bool,
        _everyday(
            "--light", help="A fifth of the tracks, less CPU, larger errors: for small computers."
        ),
    ] = False,
    quality: Annotated[
        Literal["normal", "high"],
        _everyday(help="high: where the camera was lost, read the source again, backwards."),
    ] = "normal",
    view: Annotated[
        Literal["window", "web"] | None, _everyday(help="Look on in Rerun (pliant view).")
    ] = None,
    quiet: Annotated[
        bool, _everyday("--quiet", "-q", help="Print errors alone; the exit code tells the rest.")
    ] = False,
    topic: Annotated[
        str, _source(help="The images of an MCAP file, bag or ros:HOST that has several.")
    ] = "",
    max_size: Annotated[
        int | None,
        _source(min=1, help="Pixels along the longer side [what the details need]."),
    ] = None,
    mode: Annotated[
        Literal["lossless", "live"] | None,
        _source(help="Nobody drops a frame, or the newest wins [live for a camera]."),
    ] = None,
    known: Annotated[
        Path | None,
        _maps("--map", help="Go on in the map of an earlier run: its folder or map.pliant."),
    ] = None,
    localise: Annotated[
        bool, _maps("--localise", help="Find each frame in that map, and map nothing.")
    ] = False,
    profile: Annotated[
        Literal["rigid", "deformable"],
        _deforming(help="A rigid scene's map, or surfels on a surface that deforms."),
    ] = "rigid",
    camera: Annotated[
        Literal["static", "moving"] | None,
        _deforming(help="deformable: whether the camera stands still [surfels.camera]."),
    ] = None,
    depth: Annotated[
        Literal["sensor", "map", "flat"] | None,
        _deforming(
            help="deformable: where surfels start: on depth maps of the source, on our own map of "
            "a scene that holds still at first, or on a plane [surfels.depth_from]."
        ),
    ] = None,
    depth_frames: Annotated[
        Literal["first", "all"] | None,
        _deforming(help="deformable: depth maps that are used [ingest.depth]."),
    ] = None,
    images: Annotated[
        bool, _recording("--images/--no-images", help="Record the images, too.")
    ] = True,
    save: Annotated[
        Path | None, _recording(help="What a viewer sees, as an .rrd file of Rerun's.")
    ] = None,
    config_file: Annotated[
        Path | None, _settings("--config", help="YAML file over the defaults.")
    ] = None,
    overrides: Annotated[
        list[str] | None, _settings("--set", help="KEY=VALUE over the file; may be repeated.")
    ] = None,
    seed: Annotated[int | None, _settings(help="Seed of every random choice.")] = None,
    on_crash: Annotated[
        Literal["stop", "restart"],
        _faults(help="What to do when a service dies: end the run, or restart the service."),
    ] = "stop",
    resume: Annotated[
        bool,
        _faults(
            "--resume",
            help="Take up a run again that was cut off (power, kill), with --on-crash restart.",
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
    from pliant_services.run.command import RunRequest, run_pipeline

    sets = [_LIGHT] if light else []
    sets += [*(overrides or []), *([f"ingest.mode={mode}"] if mode else [])]
    if profile == "rigid" and (camera or depth_frames or depth):
        raise typer.BadParameter("--camera, --depth and --depth-frames need --profile deformable")
    if light and profile != "rigid":
        raise typer.BadParameter("--light needs --profile rigid: surfels cost most of the other")
    if sharpest and not every:
        raise typer.BadParameter("--sharpest needs --every: of how many frames?")
    part = {"start_s": start, "end_s": end, "every": every, "longest_side_px": max_size}
    sets += [f"ingest.{name}={value}" for name, value in part.items() if value is not None]
    sets += [] if auto_mask else ["ingest.mask_static=false"]
    sets += ["ingest.sharpest=true"] if sharpest else []
    sets += [f"surfels.camera={camera}"] if camera else []
    sets += [f"surfels.depth_from={depth}"] if depth else []
    sets += [f"ingest.depth={depth_frames}"] if depth_frames else []
    if resume and poses:
        raise typer.BadParameter("--poses needs a run from its beginning, and --resume goes on")
    if localise and known is None:
        raise typer.BadParameter("--localise needs --map: a result folder or its map.pliant")
    if quality == "high" and (localise or profile != "rigid"):
        raise typer.BadParameter("--quality high needs a map that grows, of --profile rigid")
    if known is not None and profile != "rigid":
        raise typer.BadParameter("--map needs --profile rigid: surfels keep no map")
    # A map that does not grow has no new surface.
    localising = ["bundle_adjustment.only_localise=true", "meshing.enabled=false"]
    sets += localising if localise else []
    sets += [] if images else ["recorder.images=false"]
    request = RunRequest(
        source=source,
        profile=profile,
        output=output,
        force=force,
        config_file=config_file,
        overrides=sets,
        seed=seed,
        calibration=calibration,
        fov_deg=fov,
        mask=mask,
        known=known,
        topic=topic,
        view=view,
        save=save,
        poses=poses,
        port=port,
        on_crash=on_crash,
        resume=resume,
        quality=quality,
    )
    if quiet and (poses or view):
        raise typer.BadParameter("--quiet prints nothing: leave it, or --poses and --view")
    with silence() if quiet else nullcontext():
        code = run_pipeline(request)
    raise typer.Exit(code)
