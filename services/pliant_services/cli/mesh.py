"""``pliant mesh``: the mesh of a recording again, with other parameters."""

from pathlib import Path
from typing import Annotated

import typer


def mesh(
    recording: Annotated[Path, typer.Argument(help="A recording or a result folder.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Result folder [<result>_mesh].")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Overwrite the results in an existing folder.")
    ] = False,
    when_over: Annotated[
        bool,
        typer.Option("--when-over", help="Wait until the session that writes there has ended."),
    ] = False,
    clean: Annotated[
        bool, typer.Option("--clean", help="Remove pieces below 1 % of the area of the largest.")
    ] = False,
    observed: Annotated[
        bool, typer.Option("--observed", help="Leave out the surface that closes holes.")
    ] = False,
    watertight: Annotated[
        bool,
        typer.Option(
            "--watertight", help="Also write mesh_watertight.ply, a solid for 3D printers."
        ),
    ] = False,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="KEY=VALUE overrides the recorded configuration; may be repeated."
        ),
    ] = None,
) -> None:
    """Make the mesh of a recorded run again: mesh.ply, mesh_coarse.ply and their pictures.

    pliant mesh results/room --set meshing.tsdf.fine_voxel=0.005

    pliant mesh results/room --set meshing.depth=points --output results/points

    pliant mesh results/room --watertight --clean
    """
    from pliant_services.cli.info import recording_file
    from pliant_services.mesh.command import is_meshed, run_mesh

    if when_over:
        from pliant.results.folder import STATE_FOLDER
        from pliant_services.runtime.session_end import wait_until_over

        wait_until_over(recording / STATE_FOLDER)
        if is_meshed(recording, output):
            return
    for line in run_mesh(
        recording_file(recording),
        output=output,
        force=force or when_over,
        overrides=overrides or [],
        clean=clean,
        observed=observed,
        close=watertight,
    ):
        typer.echo(line)
