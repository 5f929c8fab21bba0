"""Registers every command, in the order of the help page; each lives in a file of its own."""

from pliant_services.cli import (
    app,
    batch,
    calibrate,
    certs,
    config,
    doctor,
    export,
    info,
    mesh,
    recover,
    render,
    replay,
    ros,
    router,
    run,
    scale,
    service,
    status,
    stop,
    view,
)
from pliant_services.cli import evaluate as evaluate_command
from pliant_services.cli import map as map_commands
from pliant_services.cli.groups import DEVELOPMENT, EVERYDAY, LOOK, MACHINES, GroupedOptions

app.command("run", cls=GroupedOptions, rich_help_panel=EVERYDAY)(run.run)
app.command(
    "batch",
    rich_help_panel=EVERYDAY,
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
)(batch.batch)
app.command("export", rich_help_panel=EVERYDAY)(export.export)
app.command("mesh", rich_help_panel=EVERYDAY)(mesh.mesh)
app.command("scale", rich_help_panel=EVERYDAY)(scale.scale)
app.add_typer(map_commands.app, name="map", rich_help_panel=EVERYDAY)
app.command("calibrate", rich_help_panel=EVERYDAY)(calibrate.calibrate)
app.command("config", rich_help_panel=EVERYDAY)(config.config)
app.command("doctor", rich_help_panel=EVERYDAY)(doctor.doctor)
app.command("view", rich_help_panel=LOOK)(view.view)
app.command("ros", rich_help_panel=LOOK)(ros.ros)
app.command("info", rich_help_panel=LOOK)(info.info)
app.command("eval", rich_help_panel=LOOK)(evaluate_command.evaluate)
app.command("status", rich_help_panel=LOOK)(status.status)
app.command("stop", rich_help_panel=MACHINES)(stop.stop)
app.command("service", rich_help_panel=MACHINES)(service.service)
app.command("router", rich_help_panel=MACHINES)(router.router)
app.command("certs", rich_help_panel=MACHINES)(certs.certs)
app.command("replay", rich_help_panel=DEVELOPMENT)(replay.replay)
app.command("recover", rich_help_panel=DEVELOPMENT)(recover.recover)
app.command("render", rich_help_panel=DEVELOPMENT)(render.render)
