"""``pliant status``: the services in the sessions of a router, and their health."""

from typing import Annotated

import typer

from pliant_services.cli.options import ConnectToo, Running, TlsFolder, identity_in, session_at


def status(
    result: Running = None,
    connect: ConnectToo = None,
    session: Annotated[str, typer.Option(help="Only this session [all of them].")] = "*",
    seconds: Annotated[float, typer.Option(min=1.5, help="How long to listen.")] = 3.0,
    tls: TlsFolder = None,
) -> None:
    """Show every service: host, version, frame, rate, lag, queue, faults, memory, clock.

    pliant status results/room

    pliant status --connect tcp/127.0.0.1:7447
    """
    from pliant_services.runtime.status import listen, table
    from pliant_services.security.access import OPERATOR

    endpoints, session = session_at(result, connect, session)
    services, silent = listen(endpoints, session, seconds, identity_in(tls, OPERATOR))
    if not services and not silent:
        typer.echo(f"no services on {', '.join(endpoints)}", err=True)
        raise typer.Exit(1)
    for line in table(services, silent):
        typer.echo(line)
