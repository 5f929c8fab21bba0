"""``pliant recover``: repairs a truncated or damaged recording."""

from pathlib import Path
from typing import Annotated

import typer


def recover(
    recording: Annotated[Path, typer.Argument(help="A recording or a result folder.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write [<name>_recovered.mcap].")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Recover the intact part of a damaged recording, and report the missing part.

    pliant recover results/room

    pliant recover broken.mcap --output whole.mcap
    """
    from pliant.errors import RecordingError
    from pliant.recording.parts import parts_of
    from pliant.recording.recover import recover as make_whole
    from pliant.recording.summary import describe, summarise
    from pliant.results.folder import check_free, keep_apart
    from pliant.wording import counted
    from pliant_services.cli.info import recording_file

    damaged = recording_file(recording)
    suffix = damaged.suffix or ".mcap"  # a folder of parts becomes one file
    whole = output or damaged.with_name(f"{damaged.stem}_recovered{suffix}")
    keep_apart(whole, parts_of(damaged))
    if whole.exists() and not force:
        raise RecordingError(f"{whole} exists: choose another --output, or --force to replace it")
    check_free(whole.parent)
    recovery = make_whole(damaged, whole)
    typer.echo(f"{counted(recovery.messages, 'message')} kept in {whole}")
    if recovery.unchecked:
        typer.echo(f"{recovery.unchecked} of them from a chunk that was cut off, unchecked")
    for damage in recovery.damage:
        typer.echo(f"lost at byte {damage.offset}, {counted(damage.size, 'byte')}: {damage.what}")
    for line in describe(summarise(whole)):
        typer.echo(line)
