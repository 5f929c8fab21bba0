"""``pliant replay``: a recording on the bus as if live, or services run again on a recording."""

from pathlib import Path
from typing import Annotated

import typer

from pliant.errors import PliantError
from pliant_services.cli.options import TlsFolder


def replay(
    recording: Annotated[Path, typer.Argument(help="A recording or a result folder.")],
    rate: Annotated[str, typer.Option(help="Speed relative to capture, e.g. 0.5, or max.")] = "1",
    start: Annotated[
        float, typer.Option(min=0.0, help="Start at this second of the recording.")
    ] = 0.0,
    end: Annotated[
        float | None, typer.Option(min=0.0, help="Stop at this second [the end].")
    ] = None,
    topics: Annotated[str, typer.Option(help="Topics to play, separated by commas [all].")] = "",
    readers: Annotated[
        str,
        typer.Option(help="Services to wait for; they receive every message, e.g. tracking."),
    ] = "",
    loop: Annotated[
        bool, typer.Option("--loop", help="Play again from the start at the end.")
    ] = False,
    connect: Annotated[
        list[str] | None, typer.Option("--connect", help="Router to connect to [start one].")
    ] = None,
    tls: TlsFolder = None,
    session: Annotated[str, typer.Option(help="Name of the session to play.")] = "replay",
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Port of the started router [a free one].")
    ] = None,
    services: Annotated[
        str,
        typer.Option(
            "--services",
            help="Run these services on the recording, separated by commas [all recorded].",
        ),
    ] = "",
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Result folder [<result>_replay].")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Overwrite the results in an existing folder.")
    ] = False,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="KEY=VALUE overrides the recorded configuration; may be repeated."
        ),
    ] = None,
    check: Annotated[
        bool,
        typer.Option("--check", help="Compare with the recorded messages; exit 1 if they differ."),
    ] = False,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(help="FIELD=X: values of this field may differ by X; may be repeated."),
    ] = None,
) -> None:
    """Play a recording on the bus as if live, or run services again on the recorded messages.

    pliant replay results/room --rate 0.5 --start 10

    pliant replay results/room --services tracking --check

    pliant replay results/room --services tracking,bundle_adjustment --set tracking.max_tracks=5000
    """
    from pliant_services.cli.info import recording_file

    file = recording_file(recording)
    if services or output or force or overrides or check or tolerance:
        playing = {
            "--rate": rate != "1", "--start": start, "--end": end is not None, "--topics": topics,
            "--readers": readers, "--loop": loop, "--connect": connect, "--port": port,
        }  # fmt: skip
        for option in [name for name, given in playing.items() if given]:
            raise typer.BadParameter(
                f"{option} applies to playing, not to running services again (--services, --check)"
            )
        if tolerance and not check:
            raise typer.BadParameter("--tolerance needs --check")
        from pliant_services.replay.command import ReplayRequest, run_replay

        again = ReplayRequest(
            recording=file,
            services=[name for name in services.split(",") if name],
            output=output,
            force=force,
            overrides=overrides or [],
            check=check,
            tolerances=_tolerances(tolerance or []),
        )
        raise typer.Exit(run_replay(again))
    from pliant_services.replay.play import PlayRequest, run_play

    played = PlayRequest(
        recording=file,
        rate=_rate(rate),
        start_s=start,
        end_s=end,
        topics=[key for key in topics.split(",") if key],
        readers=[name for name in readers.split(",") if name],
        loop=loop,
        connect=connect or [],
        tls=tls,
        session=session,
        port=port,
    )
    raise typer.Exit(run_play(played))


def _rate(text: str) -> float:
    """A factor, 0 for max."""
    try:
        rate = 0.0 if text == "max" else float(text)
    except ValueError:
        rate = -1.0
    if not (text == "max" or 1e-3 <= rate <= 1e3):
        raise PliantError(f"--rate {text}: expected a factor such as 0.5, or max")
    return rate


def _tolerances(texts: list[str]) -> dict[str, float]:
    found: dict[str, float] = {}
    for text in texts:
        field, _, number = text.partition("=")
        try:
            found[field] = float(number)
        except ValueError:
            raise PliantError(
                f"--tolerance {text}: expected FIELD=X, e.g. points_world=1e-9"
            ) from None
    return found
