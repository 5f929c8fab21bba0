"""``pliant render``: make a built-in sequence as a folder."""

from pathlib import Path
from typing import Annotated

import typer


def render(
    name: Annotated[str, typer.Argument(help="built-in:room, built-in:tabletop, ...")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder to copy it to [the cache].")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing folder.")] = False,
) -> None:
    """Render a built-in sequence: images, calibration, exact poses, depth and surface.

    pliant render built-in:room --output sequences/room

    pliant render "built-in:corridor?frames=100"
    """
    import shutil
    import sys

    from pliant.datasets.builtin import builtin_folder
    from pliant.errors import ResultError
    from pliant.results.folder import keep_apart

    if output is not None and output.exists() and not force:
        raise ResultError(f"{output} exists: choose another --output, or --force to replace it")

    def progress(what: str, done: int, total: int) -> None:
        if sys.stderr.isatty():
            end = "\n" if done == total else ""
            print(f"\r{what} {done} of {total} ", end=end, file=sys.stderr, flush=True)

    folder = builtin_folder(name, progress=progress)
    if output is not None:
        keep_apart(output, [folder])
        shutil.copytree(folder, output, dirs_exist_ok=force)
        folder = output
    typer.echo(str(folder))
