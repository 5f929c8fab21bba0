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
    topic: Annotated[
        str, typer.Option(help="The images of an MCAP file or ROS bag that has several.")
    ] = "",
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

    pliant run path/to/cloth --profile deformable --camera static

    pliant run path/to/tissue --profile deformable --camera moving --depth map
    """
    from pliant_services.run.command import RunRequest, run_pipeline

    sets = [*(overrides or []), *([f"ingest.mode={mode}"] if mode else [])]
    if profile == "rigid" and (camera or depth_frames or depth):
        raise typer.BadParameter("--camera, --depth and --depth-frames need --profile deformable")
    sets += [f"surfels.camera={camera}"] if camera else []
    sets += [f"surfels.depth_from={depth}"] if depth else []
    sets += [f"ingest.depth={depth_frames}"] if depth_frames else []
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
        topic=topic,
        view=view,
        save=save,
        port=port,
        on_crash=on_crash,
        resume=resume,
    )
    raise typer.Exit(run_pipeline(request))
