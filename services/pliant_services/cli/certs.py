"""``pliant certs``: an authority and a certificate for everybody in a session."""

from pathlib import Path
from typing import Annotated

import typer


def certs(
    folder: Annotated[Path, typer.Argument(help="Where they go; what is there is kept.")],
    hosts: Annotated[
        list[str] | None,
        typer.Option("--host", help="Name or address of the router's machine; may be repeated."),
    ] = None,
    authority: Annotated[
        Path | None,
        typer.Option(help="Folder of the key that signs them; by default FOLDER-authority."),
    ] = None,
    session: Annotated[
        str, typer.Option(help="The only session that they are good for [any].")
    ] = "",
) -> None:
    """Make certificates for the router, every service and the operator.

    pliant certs certs --host rack.local --host 10.0.0.2

    pliant certs lab-certs --session lab --authority certs-authority

    Give each machine ca.pem and the two files of each service that it runs.  The key that signs
    lies in a folder of its own: it is needed for nothing else, and stays here.
    """
    from pliant.bus.session import session_name
    from pliant_services.security.access import NAMES
    from pliant_services.security.certificates import ANY_SESSION, make_certificates

    names = ["localhost", "127.0.0.1", *(hosts or [])]
    only = session_name(session) if session else ANY_SESSION
    made = make_certificates(folder, NAMES, names, authority=authority, session=only)
    typer.echo(f"{folder}: made {', '.join(made)}" if made else f"{folder}: everything is there")
