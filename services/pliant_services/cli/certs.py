"""``pliant certs``: an authority, and certificates for all members of a session."""

from pathlib import Path
from typing import Annotated

import typer


def certs(
    folder: Annotated[Path, typer.Argument(help="Output folder; existing certificates are kept.")],
    hosts: Annotated[
        list[str] | None,
        typer.Option("--host", help="Name or address of the router's machine; may be repeated."),
    ] = None,
    authority: Annotated[
        Path | None,
        typer.Option(help="Folder of the signing key; by default FOLDER-authority."),
    ] = None,
    session: Annotated[
        str, typer.Option(help="The only session for which the certificates are valid [any].")
    ] = "",
) -> None:
    """Make certificates for the router, every service and the operator.

    pliant certs certs --host rack.local --host 10.0.0.2

    pliant certs lab-certs --session lab --authority certs-authority

    Give each machine ca.pem and the two files of each service that it runs.  The signing key
    is in a separate folder; keep it on this machine.
    """
    from pliant.bus.session import session_name
    from pliant_services.security.access import NAMES
    from pliant_services.security.certificates import ANY_SESSION, make_certificates

    names = ["localhost", "127.0.0.1", *(hosts or [])]
    only = session_name(session) if session else ANY_SESSION
    made = make_certificates(folder, NAMES, names, authority=authority, session=only)
    typer.echo(
        f"{folder}: made {', '.join(made)}" if made else f"{folder}: complete, nothing to do"
    )
