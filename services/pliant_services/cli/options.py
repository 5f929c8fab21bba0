"""Options that several commands share, so that they read the same everywhere."""

import os
from collections.abc import Generator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from pliant.bus.session import Identity

Connect = Annotated[
    list[str], typer.Option("--connect", help="Router endpoint, e.g. tcp/host:7447.")
]
ConnectToo = Annotated[
    list[str] | None,
    typer.Option("--connect", help="Router endpoint, instead of a result: e.g. tcp/host:7447."),
]
Running = Annotated[
    Path | None, typer.Argument(help="Result folder of an active run.", show_default=False)
]
TlsFolder = Annotated[
    Path | None, typer.Option("--tls", help="Folder made by `pliant certs`, for tls/ endpoints.")
]


@contextmanager
def silence() -> Generator[None]:
    """Nothing that is printed within is seen; errors are raised, and printed outside."""
    with (
        open(os.devnull, "w", encoding="utf-8") as nowhere,
        redirect_stdout(nowhere),
        redirect_stderr(nowhere),
    ):
        yield


def identity_in(tls: Path | None, name: str) -> "Identity | None":
    """The certificate of ``name`` in the folder, where one was given.  Raises BusError."""
    from pliant.bus.session import Identity

    return Identity.in_folder(tls, name) if tls is not None else None


def session_at(
    result: Path | None, connect: list[str] | None, session: str
) -> tuple[list[str], str]:
    """Endpoints and name of a session: of the run that writes a result, or as they are given.

    Raises ResultError if no run does, and without either.
    """
    from pliant.errors import ResultError
    from pliant_services.runtime.announced import running_session

    if result is None:
        if not connect:
            raise ResultError("no session given: pass the result folder of a run, or --connect")
        return connect, session
    endpoints, name = running_session(result)
    if not endpoints:
        raise ResultError(f"{result}: no active run in this folder")
    return endpoints, name
