"""The documentation: links, commands and lists are true, and the site reads without a network."""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import typer

import pliant
from pliant.config import describe
from pliant.export.export import EXPORTS
from pliant.messages.topics import TOPICS
from pliant_services.cli import app

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
CODE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)

import_module("pliant_services.cli.commands")  # registers them
PLIANT: Any = typer.main.get_command(app)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built as ``scripts/site`` does: a link or an anchor that leads nowhere is an error."""
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder],
        cwd=ROOT, capture_output=True, text=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


class _Loaded(HTMLParser):
    """What a browser would fetch to show a page."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Links that are followed by a click alone are none of it."""
        values = dict(attrs)
        loads = tag != "a" and not (tag == "link" and values.get("rel") in ("next", "prev"))
        found = [values.get("src"), values.get("href") if loads else None]
        self.addresses += [address for address in found if address]


def test_the_site_is_read_without_a_network(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > len(PAGES)
    for page in pages:
        loaded = _Loaded()
        loaded.feed(page.read_text(encoding="utf-8"))
        assert "assets/iframe-worker.js" in "".join(loaded.addresses)
        for address in loaded.addresses:
            assert not re.match(r"(\w+:)?//", address), (page, address)
            if page.name != "404.html":  # which knows only where a server has it
                assert (page.parent / address).exists(), (page, address)
    for sheet in site.rglob("*.css"):
        assert not re.search(r"url\(\W?(https?:)?//", sheet.read_text(encoding="utf-8")), sheet


def test_the_reference_has_everything(site: Path) -> None:
    def page(name: str) -> str:
        return (site / "reference" / f"{name}.html").read_text(encoding="utf-8")

    assert {f'id="pliant-{name}"' for name in PLIANT.commands} <= set(
        re.findall(r'id="pliant-[\w-]+"', page("commands"))
    )
    parameters = page("parameters")
    assert [key for key, *_ in describe() if f">{key}</code>" not in parameters] == []
    messages = page("messages")
    assert [topic.key for topic in TOPICS if f">{topic.key}<" not in messages] == []
    python = page("python")
    public = [name for name in vars(pliant)["_WHERE"] if f'id="pliant.{name}"' not in python]
    assert public == []


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
    assert told(table("outputs.md")) == set(EXPORTS)
    assert told(table("viewing.md")) == set(EXPORTS) - {"glb", "obj"}  # those are in meshing.md
