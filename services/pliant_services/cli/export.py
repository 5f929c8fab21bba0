"""``pliant export``: a result as files for other programs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pliant.export.kinds import KINDS
from pliant.wording import shown

if TYPE_CHECKING:
    from pliant.export.crop import Box


def export(
    result: Annotated[Path, typer.Argument(help="A result folder or a recording.")],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            help=f"{', '.join(KINDS)}.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Output file or folder [in the result folder]."),
    ] = None,
    every: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="surface, tracks: write every Nth frame [1]; animation: a key frame at every Nth "
            "frame [at most 60].",
        ),
    ] = None,
    triangles: Annotated[
        int | None, typer.Option(min=100, help="glb, obj: maximum number of triangles [40000].")
    ] = None,
    clean: Annotated[
        bool,
        typer.Option(
            "--clean", help="glb, obj: remove pieces below 1 % of the area of the largest."
        ),
    ] = False,
    observed: Annotated[
        bool, typer.Option("--observed", help="glb, obj: leave out the surface that closes holes.")
    ] = False,
    crop: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z,X,Y,Z",
            help="glb, obj, watertight, ply, splat, las: keep only the surface or the points in "
            "the box between two corners, in the frame and unit of mesh.ply.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing output.")] = False,
) -> None:
    """Export a run for other programs: viewers, trajectories, reconstructions, videos.

    pliant export results/room --to overlay

    pliant export results/room --to foxglove

    pliant export results/room --to colmap --output models/room

    pliant export results/room --to nerfstudio

    pliant export results/room --to splat

    pliant export results/room --to glb

    pliant export results/room --to glb --crop -1,-0.5,0,1,0.8,2.5

    pliant export results/cloth --to surface --every 10

    pliant export results/cloth --to animation

    pliant export recording.mcap --to kitti --output poses.txt
    """
    from functools import partial

    from pliant.export.export import export_result
    from pliant_services.cli.counting import show_progress

    written = export_result(
        result, to, output, force=force, every=every, triangles=triangles, clean=clean,
        observed=observed, crop=None if crop is None else _box(crop),
        progress=partial(show_progress, f"{to}: image"),
    )  # fmt: skip
    typer.echo(str(written))


def _box(text: str) -> "Box":
    from pliant.export.crop import Box

    try:
        x, y, z, x_end, y_end, z_end = map(float, text.split(","))
    except ValueError:
        raise typer.BadParameter(
            f"--crop {shown(text)}: expected XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX"
        ) from None
    if not (x < x_end and y < y_end and z < z_end):
        raise typer.BadParameter(f"--crop {shown(text)}: each maximum must exceed its minimum")
    return Box(low=(x, y, z), high=(x_end, y_end, z_end))
