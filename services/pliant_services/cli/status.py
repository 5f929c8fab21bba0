"""``pliant status``: who is in the sessions of a router, and how each service fares."""

from pathlib import Path
from typing import Annotated

import typer


def status(
    connect: Annotated[
        list[str], typer.Option("--connect", help="Router endpoint, e.g. tcp/host:7447.")
    ],
    session: Annotated[str, typer.Option(help="Only this session [all of them].")] = "*",
    seconds: Annotated[float, typer.Option(min=1.5, help="How long to listen.")] = 3.0,
    tls: Annotated[
        Path | None, typer.Option(help="Folder that `pliant certs` made, for tls/ endpoints.")
    ] = None,
) -> None:
    """Show every service: host, version, frame, rate, lag, queue, faults, memory, clock.

    pliant status --connect tcp/127.0.0.1:7447
    """
    from pliant.bus.session import Identity
    from pliant_services.access import OPERATOR
    from pliant_services.fleet_status import listen, table

    identity = Identity.in_folder(tls, OPERATOR) if tls is not None else None
    services = listen(connect, session, seconds, identity)
    if not services:
        typer.echo(f"no services on {', '.join(connect)}", err=True)
        raise typer.Exit(1)
    for line in table(services):
        typer.echo(line)
