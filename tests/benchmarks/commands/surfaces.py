"""Meshes and surfels against the truth, and the pictures of how they are made."""

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.commands.app import Overrides, Source, app, show


@app.command()
def mesh(
    result: Annotated[Path, typer.Argument(help="Result folder of a run.")],
    groundtruth: Annotated[
        str, typer.Option("--groundtruth", "-g", help="Folder with depth maps, or built-in:NAME.")
    ],
    overrides: Overrides = None,
) -> None:
    """Meshes of one run: NLTGV, no smoothing, Poisson, against true depth.

    scripts/bench mesh results/room --groundtruth built-in:room
    """
    from benchmarks.mesh import measure

    show(measure(result, groundtruth, overrides or []))


@app.command("mesh-live")
def mesh_live(
    result: Annotated[Path, typer.Argument(help="Result folder of a run.")],
    groundtruth: Annotated[
        str, typer.Option("--groundtruth", "-g", help="Folder with depth maps, or built-in:NAME.")
    ],
    overrides: Overrides = None,
) -> None:
    """The live mesh, of landmarks and of dense depth, and the final one, against true depth.

    scripts/bench mesh-live results/court --groundtruth built-in:court
    """
    from benchmarks.mesh import measure_live

    show(measure_live(result, groundtruth, overrides or []))


@app.command()
def surfels(
    sources: Annotated[
        list[str] | None, typer.Argument(help="Instead of the tables' own sequences.")
    ] = None,
    tracks: Annotated[
        str | None, typer.Option(help="mdh_23frames_301pts.npz of the Kinect paper.")
    ] = None,
    tables: Annotated[
        str,
        typer.Option(help="targets,models,sizes,scales,cameras,neighbours,troubles,limits,losses"),
    ] = "",
    frames: Annotated[int, typer.Option(min=2, help="Of each sequence.")] = 60,
    count: Annotated[int, typer.Option("--surfels", min=8, help="At most.")] = 200,
    quick: Annotated[bool, typer.Option("--quick", help="A few rows of each table.")] = False,
) -> None:
    """Surfels on deforming sequences with ground truth: models, sizes, scales, cameras, troubles.

    scripts/bench surfels --tracks kinect_paper_tracks/mdh_23frames_301pts.npz

    scripts/bench surfels --quick

    scripts/bench surfels path/to/cloth "built-in:sliding?light=0.5" --tables models,sizes
    """
    from benchmarks.surfels import measure

    chosen = [name for name in tables.split(",") if name]
    lines = measure(
        sources or [], tracks=tracks, tables=chosen, frames=frames, surfels=count, quick=quick
    )
    show(lines)


@app.command()
def tissue(
    source: Source,
    frames: Annotated[str, typer.Option(help="Frames to judge, from 0.")] = "50,100,150",
    without: Annotated[
        str,
        typer.Option(help="Polygon u,v,u,v,... in the first frame: surfels in it do not count."),
    ] = "",
    overrides: Overrides = None,
) -> None:
    """Surfels on a video without depth, beside Lucas-Kanade: alive, right and wrong ones.

    scripts/bench tissue path/to/folder --set patch_px=31
    """
    from benchmarks.tissue import measure

    show(measure(source, frames, without, overrides or []))


@app.command("how-pictures")
def how_pictures(
    rigid: Annotated[Path, typer.Argument(help="Result folder of built-in:room.")],
    deforming: Annotated[Path, typer.Argument(help="And of built-in:objects?frames=90.")],
    output: Annotated[Path, typer.Option("--output", "-o")] = Path("docs/how"),
) -> None:
    """The pictures of docs/how.md: extrema, flow, depth, map and surfels.

    scripts/bench how-pictures results/room results/objects
    """
    from benchmarks.how_pictures import draw

    show(draw(rigid, deforming, output))
