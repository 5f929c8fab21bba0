"""The pages of the documentation: their links, commands and lists are true."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from benchmarks.__main__ import app as bench

from pliant.algorithms.slam.atlas.known_places import Comparisons
from pliant.export.export import EXPORTS
from pliant_services.cli.commands import app

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
CODE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)

PROGRAMS: dict[str, Any] = {
    "pliant": typer.main.get_command(app),
    "scripts/bench": typer.main.get_command(bench),
}


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


def commands() -> Iterator[tuple[str, list[str]]]:
    """Each page and command of ours on it, in words, without its comment."""
    for page in PAGES:
        for block in re.findall(r"^```sh\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                words = line.split("#")[0].split()
                if len(words) > 1 and words[0] in PROGRAMS:
                    yield page.name, shlex.split(line, comments=True)


@pytest.mark.parametrize(("page", "words"), [*commands()], ids=str)
def test_commands_of_the_pages_are_commands(page: str, words: list[str]) -> None:
    """Their names and options: that they work others show."""
    program, name, *arguments = words
    command = PROGRAMS[program].commands[name]
    if hasattr(command, "commands"):
        command = command.commands[arguments.pop(0)]
    command.make_context(name, arguments)


def test_counters_of_place_comparisons_are_documented() -> None:
    told = re.findall(r"`(\w+)`", (ROOT / "docs" / "places.md").read_text(encoding="utf-8"))
    assert set(Comparisons().counters) <= set(told)


def test_lists_of_exports_are_whole() -> None:
    def told(text: str) -> set[str]:
        return set(re.findall(r"`([a-z]+)`", text))

    def table(page: str) -> str:
        text = (ROOT / "docs" / page).read_text(encoding="utf-8")
        (rows,) = re.findall(r"^\| `--to` \|.*?\n\n", text, re.MULTILINE | re.DOTALL)
        return "".join(line.split("|")[1] for line in rows.strip().splitlines())

    (kinds,) = (p for p in PROGRAMS["pliant"].commands["export"].params if p.name == "to")
    assert kinds.help == f"{', '.join(EXPORTS)}."
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert set(EXPORTS) <= told(readme)
    assert told(table("outputs.md")) == told(table("viewing.md")) == set(EXPORTS)
