"""``pliant view``: look at a run, during or after it."""

import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from pliant_services.cli.options import TlsFolder, identity_in


def view(
    source: Annotated[
        Path | None, typer.Argument(help="A result folder or a recording.", show_default=False)
    ] = None,
    connect: Annotated[
        list[str] | None, typer.Option("--connect", help="Router of a session, e.g. tcp/host:7447.")
    ] = None,
    session: Annotated[str, typer.Option(help="Name of the session at --connect.")] = "",
    tls: TlsFolder = None,
    web: Annotated[
        bool, typer.Option("--web", help="Show in a browser instead of a window.")
    ] = False,
    web_port: Annotated[
        int | None,
        typer.Option(min=1, max=65535, help="Port of --web [9090, or a free one]."),
    ] = None,
    save: Annotated[
        Path | None, typer.Option(help="Write an .rrd file instead of opening a window.")
    ] = None,
    open3d: Annotated[
        bool, typer.Option("--open3d", help="Show a result in Open3D's window, without Rerun.")
    ] = False,
    patience: Annotated[
        float, typer.Option(hidden=True, help="Seconds to wait for a session to start.")
    ] = 0.0,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Look at a run in Rerun: tracks, camera path, points, mesh, surfels.  It never slows a run.

    pliant view results/room

    pliant view results/room --web

    pliant view results/room --open3d

    pliant view --connect tcp/127.0.0.1:7447 --session run-1234
    """
    if patience > 0.0:
        # The viewer of a run, which ends this process and reports the interruption itself.
        signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    from pliant_services.security.access import OPERATOR
    from pliant_services.view.command import ViewRequest, run_view

    request = ViewRequest(
        source=source,
        endpoints=connect or [],
        session=session,
        identity=identity_in(tls, OPERATOR),
        web=web,
        web_port=web_port,
        save=save,
        force=force,
        patience_s=patience,
        open3d=open3d,
    )
    run_view(request)
