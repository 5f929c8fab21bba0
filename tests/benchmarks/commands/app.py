"""The program that the commands are registered with, and what they share."""

from collections.abc import Iterable
from typing import Annotated

import typer

app = typer.Typer(
    name="scripts/bench",
    pretty_exceptions_enable=False,
    add_completion=False,
    no_args_is_help=True,
    help="Measure speed and accuracy.  Every figure in the docs names the command that made it.",
)

Sources = Annotated[list[str], typer.Argument(help="Folders or built-in:NAME.")]
Source = Annotated[str, typer.Argument(help="Folder or built-in:NAME.")]
Overrides = Annotated[list[str] | None, typer.Option("--set", help="KEY=VALUE; may be repeated.")]


def show(lines: Iterable[str]) -> None:
    for line in lines:
        typer.echo(line)
