"""``pliant export``: a result as files for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from pliant.export.kinds import KINDS


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
        typer.Option("--output", "-o", help="Where to write [in the result folder]."),
    ] = None,
    every: Annotated[
        int | None, typer.Option(min=1, help="surface: a mesh of every so-manyth frame [1].")
    ] = None,
    triangles: Annotated[
        int | None, typer.Option(min=100, help="glb, obj: most triangles of the mesh [40000].")
    ] = None,
    clean: Annotated[
        bool,
        typer.Option("--clean", help="glb, obj: leave out pieces below 1 % of the largest one."),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace what is there.")] = False,
) -> None:
    """Write a run for other programs: viewers, trajectories, reconstructions, videos.

    pliant export results/room --to overlay

    pliant export results/room --to foxglove

    pliant export results/room --to colmap --output models/room

    pliant export results/room --to nerfstudio

    pliant export results/room --to glb

    pliant export results/cloth --to surface --every 10

    pliant export recording.mcap --to kitti --output poses.txt
    """
    from functools import partial

    from pliant.export.export import export_result
    from pliant_services.cli.counting import tell_progress

    written = export_result(
        result, to, output, force=force, every=every, triangles=triangles, clean=clean,
        progress=partial(tell_progress, f"{to}: image"),
    )  # fmt: skip
    typer.echo(str(written))
