"""Parts of the pipeline by themselves: adjustment, meshing, images for a link."""

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.commands.app import Source, app, show


@app.command()
def bundle(
    folder: Annotated[
        Path | None, typer.Option("--problems", help="Folder of BAL and libmv problems.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG of the cost over time.")] = None,
) -> None:
    """Bundle adjustment, Ceres (pyceres) and scipy: time to the same cost.  Ten minutes.

    scripts/bench bundle --problems bundle_adjustment
    """
    from benchmarks.bundle import measure

    show(measure(folder, plot))


@app.command("map-sizes")
def map_sizes(
    keyframes: Annotated[list[int], typer.Argument(min=10, help="Numbers of keyframes.")],
    points: Annotated[int, typer.Option(min=1, help="New ones in each keyframe.")] = 300,
    seen: Annotated[int, typer.Option(min=2, help="Keyframes that see each.")] = 10,
) -> None:
    """The final adjustment of synthetic maps: CPU time and memory, by their size.

    scripts/bench map-sizes 200 400 1000 3000
    """
    from benchmarks.map_sizes import measure

    show(measure(keyframes, points, seen))


@app.command("mesh-parts")
def mesh_parts(
    vertices: Annotated[int, typer.Option(min=100, help="Of the keyframe.")] = 10_000,
    repeats: Annotated[int, typer.Option(min=1, help="Of each part; the least counts.")] = 10,
    seeds: Annotated[int, typer.Option(min=1, help="Scenes for the errors.")] = 8,
) -> None:
    """The parts of meshing on a synthetic keyframe, beside the paper's, and what NLTGV gains.

    scripts/bench mesh-parts
    """
    from benchmarks.mesh_parts import measure

    show(measure(vertices, repeats, seeds))


@app.command()
def images(
    source: Source = "built-in:room",
    frames: Annotated[int, typer.Option(min=1, help="Frames to measure.")] = 12,
) -> None:
    """Images for a link between machines: how small, and what that costs on either side.

    scripts/bench images path/to/sequence
    """
    from benchmarks.images import measure

    show(measure(source, frames))
