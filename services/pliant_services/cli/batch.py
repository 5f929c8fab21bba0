"""``pliant batch``: the whole pipeline on every source of a folder."""

from pathlib import Path
from typing import Annotated

import typer


def batch(
    context: typer.Context,
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder that contains the videos, sequences and bags.", show_default=False
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder of the result folders [results/<folder>]."),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Number of parallel runs; each uses 2 cores [1].")
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(help="Dask scheduler, tcp://HOST:8786, whose workers run the clips."),
    ] = None,
) -> None:
    """Run every clip of a folder. After an interruption, repeat the command to resume.

    pliant batch clips --jobs 2

    pliant batch clips --fov 70 --every 2 --set tracking.max_tracks=5000

    pliant batch clips --dask tcp://rack.local:8786

    Options of `pliant run` follow the folder, and apply to each run.
    """
    from pliant.results.folder import folder_name
    from pliant_services.batch import command

    if dask is not None and jobs is not None:
        raise typer.BadParameter(
            "--jobs is for one machine: with --dask, set the threads of the workers"
        )
    command.check_folder(folder)
    runs = context.find_root().command.commands["run"]  # type: ignore[attr-defined]
    command.check_options(runs, context.args)
    where = output or Path("results") / folder_name(str(folder))
    raise typer.Exit(
        command.run_batch(folder, where, jobs=jobs or 1, options=context.args, dask=dask)
    )
