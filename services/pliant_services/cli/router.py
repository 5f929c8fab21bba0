"""``pliant router``: the meeting point of a session's services."""

from pathlib import Path
from typing import Annotated

import typer


def router(
    listen: Annotated[
        list[str] | None,
        typer.Option(help="Endpoint to listen on; may be repeated [tcp/127.0.0.1:7447]."),
    ] = None,
    tls: Annotated[
        Path | None,
        typer.Option(
            help="Folder made by `pliant certs`; each certificate permits certain topics."
        ),
    ] = None,
    sessions: Annotated[
        list[str] | None,
        typer.Option(
            "--session",
            help="With --tls: session with its own certificates (pliant certs --session); may be "
            "repeated [certificates are valid for all sessions].",
        ),
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="Exit after the first session.")] = False,
) -> None:
    """Run a router until Ctrl-C.  Services on any machine connect to it.

    pliant router

    pliant router --listen tls/0.0.0.0:7447 --tls certs
    """
    import os
    import signal

    from pliant.bus.peers import OVER_KEY
    from pliant.bus.session import Identity, is_beyond_loopback, open_router, session_name
    from pliant.errors import PliantError
    from pliant_services.runtime.relay import Relays
    from pliant_services.security.access import access_control
    from pliant_services.security.certificates import ROUTER

    # A pipe: the wait for a lock does not end if a signal comes just before it, or to another
    # thread.
    stopped, stop = os.pipe()
    os.set_blocking(stop, False)
    signal.set_wakeup_fd(stop)

    def on_signal(*_: object) -> None:
        """Do nothing: Python has written to the pipe."""

    for kind in (signal.SIGINT, signal.SIGTERM):
        signal.signal(kind, on_signal)
    endpoints = listen or ["tcp/127.0.0.1:7447"]
    secure = tls is not None
    if sessions and not secure:
        raise PliantError(
            "--session needs --tls: without certificates every client can access all sessions"
        )
    served = [session_name(each) for each in sessions or ()]
    open_to_all = [] if secure else [each for each in endpoints if is_beyond_loopback(each)]
    if open_to_all:
        typer.echo(
            f"WARNING: {', '.join(open_to_all)} is reachable from other machines and requires no "
            "certificate: anyone who reaches it can see all images and send any message. See "
            "`pliant certs`.",
            err=True,
        )
    session = open_router(
        *endpoints,
        identity=Identity.in_folder(tls, ROUTER) if tls is not None else None,
        access_control=access_control(served) if secure else None,
    )

    def on_over(_: object) -> None:
        if once:
            os.write(stop, b"\0")

    held = session.declare_subscriber(f"pliant/*/{OVER_KEY}", on_over)
    typer.echo(f"router on {', '.join(endpoints)}", err=True)
    relays = Relays(session)
    os.read(stopped, 1)
    relays.close()
    held.undeclare()
    session.close()  # type: ignore[no-untyped-call]
