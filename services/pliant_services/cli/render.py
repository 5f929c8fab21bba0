"""``pliant render``: make a built-in sequence as a folder."""

from pathlib import Path
from typing import Annotated

import typer


def render(
    name: Annotated[str, typer.Argument(help="built-in:room, built-in:tabletop, ...")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Output folder [the cache].")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing folder.")] = False,
) -> None:
    """Render a built-in sequence: images, calibration, exact poses, depth and surface.

    pliant render built-in:room --output sequences/room

    pliant render "built-in:corridor?frames=100"
    """
    import shutil

    from pliant.datasets.builtin import builtin_folder
    from pliant.errors import ResultError
    from pliant.results.folder import keep_apart
    from pliant_services.cli.counting import show_progress

    if output is not None and output.exists() and not force:
        raise ResultError(f"{output} exists: choose another --output, or --force to replace it")

    folder = builtin_folder(name, progress=show_progress)
    if output is not None:
        keep_apart(output, [folder])
        shutil.copytree(folder, output, dirs_exist_ok=force)
        folder = output
    typer.echo(str(folder))
