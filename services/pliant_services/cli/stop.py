"""``pliant stop``: end a session cleanly."""

from pathlib import Path
from typing import Annotated

import typer


def stop(
    connect: Annotated[
        list[str], typer.Option("--connect", help="Router endpoint, e.g. tcp/host:7447.")
    ],
    session: Annotated[str, typer.Option(help="Name of the session to end.")] = "default",
    wait: Annotated[float, typer.Option(min=0.0, help="Seconds to wait for its end.")] = 60.0,
    tls: Annotated[
        Path | None, typer.Option(help="Folder that `pliant certs` made, for tls/ endpoints.")
    ] = None,
) -> None:
    """End the source after the frame at hand; the others follow once they have read everything.

    pliant stop --connect tcp/127.0.0.1:7447
    """
    from pliant.bus.session import Identity
    from pliant_services.access import OPERATOR
    from pliant_services.fleet_status import stop_session

    identity = Identity.in_folder(tls, OPERATOR) if tls is not None else None
    left = stop_session(connect, session, wait, identity)
    if left:
        typer.echo(f"pliant: {', '.join(left)} still there after {wait:.0f} s", err=True)
        raise typer.Exit(1)
