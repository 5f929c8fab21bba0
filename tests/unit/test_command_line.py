"""What the command line says of itself, and of the installation."""

import sys
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

import pliant
from pliant_services.cli import doctor
from pliant_services.cli.commands import app
from pliant_services.cli.groups import DEVELOPMENT, EVERYDAY, LOOK, MACHINES

COMMANDS: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]


def shown(*arguments: str) -> str:
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    return done.output


def without_spaces(text: str) -> str:
    return "".join(text.split())


@pytest.mark.parametrize("name", COMMANDS)
def test_help_texts_are_shown_whole(name: str) -> None:
    """With the defaults that stand [in brackets], which Rich would take for markup."""
    page = without_spaces(shown(name, "--help"))
    command = COMMANDS[name]
    texts = [p.help for p in command.params if getattr(p, "help", "") and not p.hidden]
    for text in (*texts, *command.help.split("\n\n")):
        assert without_spaces(text) in page


def headings(page: str) -> list[str]:
    return [line.rstrip(":") for line in page.splitlines() if line.rstrip().endswith(":")]


def test_commands_stand_in_groups() -> None:
    page = shown("--help")
    groups = [EVERYDAY, LOOK, MACHINES, DEVELOPMENT]
    assert headings(page) == ["Options", *groups]
    assert {command.rich_help_panel for command in COMMANDS.values()} == set(groups)
    assert page.index("  run ") < page.index("  export ") < page.index(f"{LOOK}:")


def test_options_of_run_stand_in_groups_the_everyday_ones_first() -> None:
    page = shown("run", "--help")
    first, second, *_, last = headings(page)[1:]  # after the arguments
    assert (first, last) == ("Everyday options", "Options")
    assert page.index(first) < page.index("--output <") < page.index("--fov <") < page.index(second)
    assert page[page.index(f"\n{last}:") :].split()[1] == "--help"


def test_the_version_is_said() -> None:
    assert shown("--version") == f"pliant {pliant.__version__}\n"


def test_a_missing_package_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "threadpoolctl", None)
    (found,) = (f for f in doctor.diagnose() if f.what == "arithmetic")
    assert found.grade == "error"


def test_what_plots_is_a_warning_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    for module, told in ((SimpleNamespace(__version__="9.8.7"), ("ok", "9.8.7")), (None, None)):
        monkeypatch.setitem(sys.modules, "matplotlib", module)
        (found,) = (f for f in doctor.diagnose() if f.what == "matplotlib")
        if told is not None:
            assert (found.grade, found.detail) == told
        else:
            assert found.grade == "warning"
            assert "pip install 'pliant[plot]'" in found.detail
