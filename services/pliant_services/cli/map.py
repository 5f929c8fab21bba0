"""``pliant map``: the content of a saved map, and the merge of two maps."""

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Saved maps (map.pliant).")


@app.callback()
def _maps() -> None:
    """Maps that are kept: map.pliant."""


@app.command()
def info(
    path: Annotated[Path, typer.Argument(help="A result folder or its map.pliant.")],
) -> None:
    """Show and check a map: sessions, segments, keyframes, points, camera and size.

    pliant map info results/office
    """
    from pliant.recording.map_file import describe

    for line in describe(path):
        typer.echo(line)


@app.command()
def merge(
    first: Annotated[Path, typer.Argument(help="A result folder or its map.pliant.")],
    second: Annotated[Path, typer.Argument(help="A second map with places of the first.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Map file to write.")],
    force: Annotated[bool, typer.Option("--force", help="Replace existing output.")] = False,
) -> None:
    """Merge two maps that show the same places, in the frame and at the scale of the first.

    pliant map merge results/monday results/tuesday --output results/office.pliant
    """
    from pliant.results.merged_map import merge_maps

    for line in merge_maps(first, second, output, force=force):
        typer.echo(line)
