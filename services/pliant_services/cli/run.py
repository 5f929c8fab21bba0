"""``pliant run``: the whole pipeline on one source."""

from pathlib import Path
from typing import Annotated, Literal

import typer


def run(
    source: Annotated[
        str,
        typer.Argument(
            help="Folder, video, bag, MCAP file, camera:0 or built-in:room.", show_default=False
        ),
    ],
    profile: Annotated[
        Literal["rigid", "deformable"],
        typer.Option(help="A rigid scene's map, or surfels on a surface that deforms."),
    ] = "rigid",
    camera: Annotated[
        Literal["static", "moving"] | None,
        typer.Option(help="deformable: whether the camera stands still [surfels.camera]."),
    ] = None,
    depth_frames: Annotated[
        Literal["first", "all"] | None,
        typer.Option(help="deformable: depth maps that are used [ingest.depth]."),
    ] = None,
    depth: Annotated[
        Literal["sensor", "map", "flat"] | None,
        typer.Option(
            help="deformable: where surfels start: on depth maps of the source, on our own map of "
            "a scene that holds still at first, or on a plane [surfels.depth_from]."
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Result folder [results/<source>].")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Write into an existing folder.")] = False,
    config_file: Annotated[
        Path | None, typer.Option("--config", help="YAML file over the defaults.")
    ] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", help="KEY=VALUE over the file; may be repeated.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of every random choice.")] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration of a video, a camera or bare images.")
    ] = None,
    fov: Annotated[
        float | None, typer.Option(help="Horizontal field of view in degrees, for a first try.")
    ] = None,
    known: Annotated[
        Path | None,
        typer.Option("--map", help="Go on in the map of an earlier run: its folder or map.pliant."),
    ] = None,
    localise: Annotated[
        bool, typer.Option("--localise", help="Find each frame in that map, and map nothing.")
    ] = False,
    topic: Annotated[
        str, typer.Option(help="The images of an MCAP file or ROS bag that has several.")
    ] = "",
    start: Annotated[
        float | None, typer.Option(min=0.0, help="Begin so many seconds after the first frame.")
    ] = None,
    end: Annotated[
        float | None, typer.Option(min=0.0, help="End so many seconds after the first frame.")
    ] = None,
    every: Annotated[
        int | None, typer.Option(min=1, help="Take one of so many frames [1].")
    ] = None,
    sharpest: Annotated[
        bool, typer.Option("--sharpest", help="With --every: the sharpest of them, not the first.")
    ] = False,
    max_size: Annotated[
        int | None,
        typer.Option(min=1, help="Pixels along the longer side [what the details need]."),
    ] = None,
    view: Annotated[
        Literal["window", "web"] | None, typer.Option(help="Look on in Rerun (pliant view).")
    ] = None,
    save: Annotated[
        Path | None, typer.Option(help="What a viewer sees, as an .rrd file of Rerun's.")
    ] = None,
    mode: Annotated[
        Literal["lossless", "live"] | None,
        typer.Option(help="Nobody drops a frame, or the newest wins [live for a camera]."),
    ] = None,
    on_crash: Annotated[
        Literal["stop", "restart"],
        typer.Option(help="A service that dies ends the run, or goes on where it was."),
    ] = "stop",
    resume: Annotated[
        bool, typer.Option("--resume", help="Take up a run again that was cut off (power, kill).")
    ] = False,
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Port of the router [a free one].")
    ] = None,
    images: Annotated[
        bool, typer.Option("--images/--no-images", help="Record the images, too.")
    ] = True,
) -> None:
    """Track, map and record a video; write trajectory, points and report.

    pliant run built-in:room

    pliant run path/to/sequence --output results/kitchen --force

    pliant run video.mp4 --calibration calib.yaml

    pliant run drive.bag --topic /camera/image_raw

    pliant run video.mp4 --fov 70 --set tracking.max_tracks=5000

    pliant run video.mp4 --start 10 --end 40 --every 5 --sharpest

    pliant run today.mp4 --calibration calib.yaml --map results/yesterday

    pliant run camera:0 --calibration calib.yaml --map results/office --localise

    pliant run path/to/cloth --profile deformable --camera static

    pliant run path/to/tissue --profile deformable --camera moving --depth map
    """
    from pliant_services.run.command import RunRequest, run_pipeline

    sets = [*(overrides or []), *([f"ingest.mode={mode}"] if mode else [])]
    if profile == "rigid" and (camera or depth_frames or depth):
        raise typer.BadParameter("--camera, --depth and --depth-frames need --profile deformable")
    if sharpest and not every:
        raise typer.BadParameter("--sharpest needs --every: of how many frames?")
    part = {"start_s": start, "end_s": end, "every": every, "longest_side_px": max_size}
    sets += [f"ingest.{name}={value}" for name, value in part.items() if value is not None]
    sets += ["ingest.sharpest=true"] if sharpest else []
    sets += [f"surfels.camera={camera}"] if camera else []
    sets += [f"surfels.depth_from={depth}"] if depth else []
    sets += [f"ingest.depth={depth_frames}"] if depth_frames else []
    if localise and known is None:
        raise typer.BadParameter("--localise needs --map: a result folder or its map.pliant")
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
        known=known,
        topic=topic,
        view=view,
        save=save,
        port=port,
        on_crash=on_crash,
        resume=resume,
    )
    raise typer.Exit(run_pipeline(request))
