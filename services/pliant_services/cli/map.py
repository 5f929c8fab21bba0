"""``pliant map``: what a kept map holds."""

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Maps that are kept: map.pliant."
)


@app.callback()
def _maps() -> None:
    """Maps that are kept: map.pliant."""


@app.command()
def info(
    path: Annotated[Path, typer.Argument(help="A result folder or its map.pliant.")],
) -> None:
    """Sessions, segments, keyframes, points, camera and size of a map; whether it is whole.

    pliant map info results/office
    """
    from pliant.recording.map_file import describe

    for line in describe(path):
        typer.echo(line)
