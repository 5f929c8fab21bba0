"""The documentation as a site: it is whole, and reads without a network, out of a folder."""

import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
import typer

import pliant
from pliant.config import describe
from pliant.messages.topics import TOPICS
from pliant_services.cli.commands import app

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]

COMMANDS: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]


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
    assert len(pages) > len([*(ROOT / "docs").glob("*.md")])
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

    assert {f'id="pliant-{name}"' for name in COMMANDS} <= set(
        re.findall(r'id="pliant-[\w-]+"', page("commands"))
    )
    parameters = page("parameters")
    assert [key for key, *_ in describe() if f">{key}</code>" not in parameters] == []
    messages = page("messages")
    assert [topic.key for topic in TOPICS if f">{topic.key}<" not in messages] == []
    python = page("python")
    public = [name for name in vars(pliant)["_WHERE"] if f'id="pliant.{name}"' not in python]
    assert public == []


def test_the_search_works_out_of_a_folder(site: Path, tmp_path: Path) -> None:
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("chromium is not installed")
    done = subprocess.run(
        [
            *(browser, "--headless", "--no-sandbox", "--virtual-time-budget=20000", "--dump-dom"),
            *(
                f"--user-data-dir={tmp_path / 'browser'}",
                f"{(site / 'index.html').as_uri()}?q=nltgv",
            ),
        ],
        capture_output=True,
        text=True,
        timeout=300,
    )
    found = re.findall(r'<a href="([^"]*)" class="md-search-result__link"', done.stdout)
    assert any("meshing.html" in address for address in found), done.stderr
