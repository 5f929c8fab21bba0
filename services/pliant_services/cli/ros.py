"""``pliant ros``: a running session as topics of ROS 2."""

from typing import Annotated

import typer

from pliant_services.cli.options import ConnectToo, Running, TlsFolder, identity_in, session_at


def ros(
    result: Running = None,
    connect: ConnectToo = None,
    session: Annotated[str, typer.Option(help="Name of the session at --connect.")] = "",
    tls: TlsFolder = None,
    router: Annotated[
        str, typer.Option(help="Router of rmw_zenoh (ros2 run rmw_zenoh_cpp rmw_zenohd).")
    ] = "tcp/localhost:7447",
    name: Annotated[str, typer.Option(help="Prefix of all topics except /tf.")] = "/pliant",
    patience: Annotated[
        float, typer.Option(min=0.0, help="Seconds to wait for a session to start.")
    ] = 0.0,
) -> None:
    """Publish an active run in ROS 2: poses, cloud, mesh, images.  It never slows a run.

    pliant ros results/room

    ROS_DOMAIN_ID=7 pliant ros results/room --router tcp/robot:7447

    pliant ros --connect tcp/127.0.0.1:7447 --session run-1234

    ROS 2 has to use rmw_zenoh_cpp (Jazzy or later). Needs pip install 'pliant[bags]', and no ROS.
    """
    from pliant_services.ros.command import RosRequest, run_ros
    from pliant_services.security.access import OPERATOR

    endpoints, session = session_at(result, connect, session)
    request = RosRequest(
        endpoints=endpoints,
        session=session,
        identity=identity_in(tls, OPERATOR),
        router=router,
        name=name,
        patience_s=patience,
    )
    run_ros(request)
