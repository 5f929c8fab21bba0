"""Against other lenses, sizes, motions and programs."""

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.commands.app import Overrides, Sources, app, show


@app.command("unknown-lens")
def unknown_lens(
    sources: Sources,
    frames: Annotated[int | None, typer.Option(min=2, help="First frames [all].")] = None,
    overrides: Overrides = None,
) -> None:
    """Sources without a calibration and with wrong ones: the estimated calibration, and the error.

    scripts/bench unknown-lens path/to/tsukuba150 built-in:room --frames 200
    """
    from benchmarks.unknown_lens import measure

    show(measure(sources, frames, overrides or []))


@app.command()
def coverage(
    sources: Sources,
    seeds: Annotated[int, typer.Option(min=1, help="Seeds, from 0.")] = 1,
    frames: Annotated[int | None, typer.Option(min=2, help="First frames [all].")] = None,
) -> None:
    """Whether the focal length and the scale are as near as their standard deviations say.

    scripts/bench coverage path/to/tsukuba150 built-in:room
    """
    from benchmarks.coverage import measure

    show(measure(sources, range(seeds), frames))


@app.command("any-size")
def any_size(
    sources: Sources,
    sizes: Annotated[list[str], typer.Option("--size", help="WIDTHxHEIGHT; may be repeated.")],
    frames: Annotated[int, typer.Option(min=2, help="First frames.")] = 60,
    overrides: Overrides = None,
) -> None:
    """The same frames at several sizes, rendered, enlarged or made smaller: the map of each.

    scripts/bench any-size built-in:room --size 320x240 --size 640x480 --size 1920x1440
    """
    from benchmarks.any_size import measure

    show(measure(sources, sizes, frames, overrides or []))


@app.command("surfel-speed")
def surfel_speed(
    source: Annotated[
        str | None, typer.Argument(help="Folder with depth, or built-in:NAME.  Default: a board.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, help="Frames to measure.")] = 17,
    surfels: Annotated[int, typer.Option(min=8, help="Most surfels.")] = 500,
) -> None:
    """Surfels per stage, compared with OpenCV's pyramidal LK for the same points.

    scripts/bench surfel-speed path/to/cloth
    """
    from benchmarks.surfel_speed import measure

    show(measure(source, frames, surfels))


@app.command("exported-models")
def exported_models(
    results: Annotated[list[Path], typer.Argument(help="Result folders of runs.")],
) -> None:
    """COLMAP models of runs and COLMAP's own of the same images: held-out reprojection.

    scripts/bench exported-models results/room
    """
    from benchmarks.exported_models import measure

    show(measure(results))


@app.command("held-out")
def held_out(
    results: Annotated[list[Path], typer.Argument(help="Result folders of runs.")],
) -> None:
    """The textured mesh compared with frames that are no keyframes: ZNCC, holes, colours.

    scripts/bench held-out results/room
    """
    from benchmarks.held_out import measure

    show(measure(results))


@app.command()
def colmap(
    sources: Annotated[list[str], typer.Argument(help="Sequences with a ground truth.")],
) -> None:
    """The same clip through COLMAP and through Pliant: time, ATE, points.

    scripts/bench colmap path/to/tsukuba150 built-in:room
    """
    from benchmarks.colmap import measure

    show(measure(sources))


@app.command("drone-flights")
def drone_flights(
    motions: Annotated[Path, typer.Argument(help="Folder of TUM files: EuRoC's true motions.")],
    only: Annotated[
        list[str] | None, typer.Option("--only", help="Names of flights; may be repeated.")
    ] = None,
    frames: Annotated[int | None, typer.Option(min=2, help="First frames of each only.")] = None,
    overrides: Overrides = None,
) -> None:
    """EuRoC's motions through a rendered hall and room.  All eleven take two hours.

    scripts/bench drone-flights euroc_gt_leftcam --only V102
    """
    from benchmarks.drone_flights import measure

    show(measure(motions, only=only or [], frames=frames, overrides=overrides or []))


@app.command()
def inertial(
    motions: Annotated[
        Path | None, typer.Argument(help="Folder of TUM files: EuRoC's true motions.")
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option("--only", help="Names of motions; may be repeated.")
    ] = None,
    runs: Annotated[
        list[str] | None,
        typer.Option("--run", help="Motions and built-in scenes to estimate; may be repeated."),
    ] = None,
    frames: Annotated[int, typer.Option(min=100, help="First frames of motions to run.")] = 600,
    seeds: Annotated[int, typer.Option(min=1, help="Sensors and noises of each motion.")] = 4,
    gyro: Annotated[
        str | None,
        typer.Option(help="Instead, the poses of --run with a gyro and without: dark or seen."),
    ] = None,
    coupled: Annotated[
        bool, typer.Option(help="Instead, the maps of --run after samples have moved keyframes.")
    ] = False,
) -> None:
    """Scale, vertical, offset and rotation from inertial samples, and what wrong ones come to.

    scripts/bench inertial euroc_gt_leftcam --run tabletop --run V102
    scripts/bench inertial --run room --gyro dark
    scripts/bench inertial euroc_gt_leftcam --run V102 --coupled
    """
    from benchmarks.coupled import measure as at_the_end
    from benchmarks.dark_turns import compare
    from benchmarks.dark_turns import measure as in_the_dark
    from benchmarks.inertial import measure

    if gyro is not None:
        with_gyro = in_the_dark if gyro == "dark" else compare
        show(with_gyro(motions, runs or [], frames, seeds))
        return
    if coupled:
        show(at_the_end(motions, runs or [], frames, seeds))
        return
    show(measure(motions, only=only or [], runs=runs or [], frames=frames, seeds=seeds))
