"""``pliant info``: the content of a recording."""

from pathlib import Path
from typing import Annotated

import typer


def info(
    recording: Annotated[Path, typer.Argument(help="A recording or a result folder.")],
    config: Annotated[
        bool, typer.Option("--config", help="Print the configuration of the run.")
    ] = False,
) -> None:
    """Show the content of a recording: duration, topics, sizes, gaps, and whether it is complete.

    pliant info results/room

    pliant info results/room/recording.mcap --config
    """
    from pliant.recording.summary import describe, summarise

    summary = summarise(recording_file(recording))
    if config:
        typer.echo(summary.metadata.get("config", {}).get("yaml", ""), nl=False)
        return
    for line in describe(summary):
        typer.echo(line)


def recording_file(path: Path) -> Path:
    """The recording of a result folder, or the file or folder of parts itself."""
    from pliant.recording.parts import parts_in

    return path / "recording.mcap" if path.is_dir() and not parts_in(path) else path
