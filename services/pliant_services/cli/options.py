"""Options that several commands share, so that they read the same everywhere."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from pliant.bus.session import Identity

Connect = Annotated[
    list[str], typer.Option("--connect", help="Router endpoint, e.g. tcp/host:7447.")
]
TlsFolder = Annotated[
    Path | None, typer.Option("--tls", help="Folder that `pliant certs` made, for tls/ endpoints.")
]


def identity_in(tls: Path | None, name: str) -> "Identity | None":
    """The certificate of ``name`` in the folder, where one was given.  Raises BusError."""
    from pliant.bus.session import Identity

    return Identity.in_folder(tls, name) if tls is not None else None
