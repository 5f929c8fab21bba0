"""``pliant stop``: end a session cleanly."""

from typing import Annotated

import typer

from pliant_services.cli.options import ConnectToo, Running, TlsFolder, identity_in, session_at


def stop(
    result: Running = None,
    connect: ConnectToo = None,
    session: Annotated[str, typer.Option(help="Name of the session to end.")] = "default",
    wait: Annotated[float, typer.Option(min=0.0, help="Seconds to wait for its end.")] = 60.0,
    tls: TlsFolder = None,
) -> None:
    """End the source after the current frame; the other services end once they have read all of it.

    pliant stop results/room

    pliant stop --connect tcp/127.0.0.1:7447
    """
    from pliant.errors import BusError
    from pliant_services.runtime.status import stop_session
    from pliant_services.security.access import OPERATOR

    endpoints, session = session_at(result, connect, session)
    left = stop_session(endpoints, session, wait, identity_in(tls, OPERATOR))
    if left:
        raise BusError(f"{', '.join(left)} still active after {wait:.0f} s")
