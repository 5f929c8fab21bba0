"""Help pages in groups: commands and options under the heading that they are declared with."""

from typing import Any

from typer.core import TyperCommand, TyperGroup

GROUPS = EVERYDAY, LOOK, MACHINES, DEVELOPMENT = "Everyday", "Look", "Machines", "Development"
"""Groups of commands: their ``rich_help_panel``, which typer shows with Rich alone: that would load
half of Rich for each help page, and take [the defaults] in help texts for markup."""


class GroupedCommands(TyperGroup):
    """``pliant``: each command with the whole first sentence of its help."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        groups: dict[str, list[tuple[str, str]]] = {name: [] for name in GROUPS}
        for name in self.list_commands(ctx):
            command: Any = self.get_command(ctx, name)
            if not command.hidden:
                row = name, command.get_short_help_str(1000)
                groups.setdefault(command.rich_help_panel or "Other", []).append(row)
        _write(groups, formatter)


class GroupedOptions(TyperCommand):
    """A command with many options: each under its heading, in the order of declaration."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        _write(grouped_options(self, ctx), formatter)


def grouped_options(command: Any, context: Any) -> dict[str, list[tuple[str, str]]]:
    """Arguments and options of a command, grouped as on its help page."""
    groups: dict[str, list[tuple[str, str]]] = {}
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if record is not None:
            kind = "Arguments" if parameter.param_type_name == "argument" else "Options"
            panel: str | None = getattr(parameter, "rich_help_panel", None)
            groups.setdefault(panel or kind, []).append(record)
    return groups


def _write(groups: dict[str, list[tuple[str, str]]], formatter: Any) -> None:
    # One width for all, so that the second column is one.
    widest = max(len(first) for rows in groups.values() for first, _ in rows)
    for heading, rows in groups.items():
        if rows:
            with formatter.section(heading):
                formatter.write_dl([(first.ljust(widest), text) for first, text in rows])
