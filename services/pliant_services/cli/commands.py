"""Registers every command; each lives in a file of its own."""

from pliant_services.cli import (
    app,
    certs,
    config,
    doctor,
    export,
    info,
    mesh,
    recover,
    render,
    replay,
    router,
    run,
    service,
    status,
    stop,
    view,
)
from pliant_services.cli import evaluate as evaluate_command
from pliant_services.cli import map as map_commands

app.command("run")(run.run)
app.command("service")(service.service)
app.command("certs")(certs.certs)
app.command("router")(router.router)
app.command("status")(status.status)
app.command("stop")(stop.stop)
app.command("eval")(evaluate_command.evaluate)
app.command("export")(export.export)
app.command("view")(view.view)
app.command("mesh")(mesh.mesh)
app.command("info")(info.info)
app.add_typer(map_commands.app, name="map")
app.command("recover")(recover.recover)
app.command("replay")(replay.replay)
app.command("render")(render.render)
app.command("config")(config.config)
app.command("doctor")(doctor.doctor)
