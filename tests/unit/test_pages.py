"""The pages of the documentation: their links, commands and lists are true."""

import re
import shlex
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import typer

from pliant.export.export import EXPORTS
from pliant_services.cli import app

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
CODE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)

import_module("pliant_services.cli.commands")  # registers them
PLIANT: Any = typer.main.get_command(app)


def heading_links(page: Path) -> set[str]:
    """The anchors that a git host gives the headings of a page."""
    text = re.sub(CODE, "", page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    shown = [re.sub(r"\[([^]]*)\]\([^)]*\)|`", r"\1", heading).lower() for heading in headings]
    return {re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in shown}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_hold_on_a_git_host(page: Path) -> None:
    text = re.sub(CODE, "", page.read_text(encoding="utf-8"))
    for target, anchor in re.findall(r"\]\((?!\w+:)([^)#\s]*)#?([^)\s]*)\)", text):
        file = (page.parent / target).resolve() if target else page
        assert file.is_file(), (page.name, target)
        assert not anchor or anchor in heading_links(file), (page.name, target, anchor)


def commands() -> Iterator[tuple[str, str]]:
    """Each (page, ``pliant`` command) of the pages, without its comment."""
    for page in PAGES:
        for block in re.findall(r"^```sh\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                if line.startswith("pliant "):
                    yield page.name, line.partition(" #")[0].strip()


@pytest.mark.parametrize(("page", "line"), [*commands()])
def test_commands_of_the_pages_are_commands(page: str, line: str) -> None:
    """Their names and options: that they work others show."""
    command, (_, name, *arguments) = PLIANT, shlex.split(line)
    command = PLIANT.commands[name]
    if hasattr(command, "commands"):
        command = command.commands[arguments.pop(0)]
    command.make_context(name, arguments)


def test_lists_of_exports_are_whole() -> None:
    def told(text: str) -> set[str]:
        return set(re.findall(r"`([a-z]+)`", text))

    def table(page: str) -> str:
        text = (ROOT / "docs" / page).read_text(encoding="utf-8")
        (rows,) = re.findall(r"^\| `--to` \|.*?\n\n", text, re.MULTILINE | re.DOTALL)
        return "".join(line.split("|")[1] for line in rows.strip().splitlines())

    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert set(EXPORTS) <= told(readme)
    assert told(table("outputs.md")) == told(table("viewing.md")) == set(EXPORTS)
