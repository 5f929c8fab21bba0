"""``pliant config``: print and check the configuration."""

from pathlib import Path
from typing import Annotated

import typer


def config(
    file: Annotated[Path | None, typer.Option("--config", help="A YAML file to check.")] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", help="KEY=VALUE overrides the file; may be repeated."),
    ] = None,
    explain: Annotated[bool, typer.Option("--explain", help="Explain each key.")] = False,
) -> None:
    """Print the resolved configuration as YAML, or one line for its first error.

    pliant config

    pliant config --config my.yaml --set bus.window=8

    pliant config --explain
    """
    from pliant.config import config_yaml, describe, load_config

    resolved = load_config(file, overrides or [])
    if explain:
        for key, default, meaning in describe():
            typer.echo(f"{key} = {default}\n    {meaning}")
    else:
        typer.echo(config_yaml(resolved), nl=False)
