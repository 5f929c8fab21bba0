"""The command line: every command in the order of the help page, each in a file of its own."""

from typing import Annotated, Any, cast

import typer

from pliant import __version__
from pliant_services.cli import (
    UsageError,
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
from pliant_services.cli.groups import (
    DEVELOPMENT,
    EVERYDAY,
    LOOK,
    MACHINES,
    GroupedCommands,
    GroupedOptions,
)

# Typer carries its own copy of click, or uses click itself, depending on its version.
_UsageError: type[typer.BadParameter] = next(
    cast(Any, c) for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException"
)

app = typer.Typer(
    name="pliant",
    cls=GroupedCommands,
    no_args_is_help=True,
    add_completion=False,
    context_settings={"max_content_width": 100},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # it would take [the defaults] in help texts for markup
    help="Trajectory, dense map and deforming surfaces from the video of one camera.\n\n"
    "  pliant run clip.mp4\n\n"
    "  pliant export results/clip.mp4 --to glb\n\n"
    "  pliant run built-in:room --output results/room\n\n"
    "  pliant eval results/room --groundtruth built-in:room\n\n"
    "Exit codes: 0 done, 1 error or failed check, 2 wrong usage, 3 finished without a map or with "
    "frames broken or missing, 130 interrupted.",
)


def run_command(application: typer.Typer) -> Any:
    """Run the command of ``sys.argv``.  Raises UsageError, KeyboardInterrupt, PliantError."""
    try:
        return application(standalone_mode=False)
    except _UsageError as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            error.show()
            raise UsageError("") from None
        command = getattr(getattr(error, "ctx", None), "command_path", "pliant")
        text = error.format_message().replace("Value error, ", "").rstrip(".")
        raise UsageError(f"{text} (see {command} --help)", error.exit_code) from None
    except typer.Abort:  # not all versions of Typer hand an interruption on
        raise KeyboardInterrupt from None


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"pliant {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_print_version, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Handle the options before a command."""


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
