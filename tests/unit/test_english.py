"""Pages and ``--help`` use the words of the field, in lines of a readable length."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

import pliant_services.cli.commands  # noqa: F401  registers them
from pliant_services.cli import app

ROOT = Path(__file__).parents[2]
LATER = {"meshing.md"}  # Pages that are not rewritten yet.
PAGES = [
    page
    for page in sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
    if page.name not in LATER
]
LONGEST_LINE = 150  # characters, outside of tables and code

# Idioms, each with the word to use.
BANNED = {
    r"told(?! (apart|otherwise|to|not))": "reported, given, flagged",
    r"what tells": "name the subject",
    r"tells? of": "reports, shows",
    r"ask(s|ed)? for": "requests, requires, needs",
    r"beside (COLMAP|the frames|tracking|other runs|the truth)": "compared with, in parallel with",
    r"carried off": "relocated",
    r"by the seed|what seeds do": "depending on the seed, spread between seeds",
    r"causal": "online",
    r"so-manyth": "every Nth",
    r"(a|the) run says|the end of a run says": "the summary shows",
    r"nobody('s| describes)": "name the subject",
    r"(?<!ground[ -])truth": "ground truth",
    r"(goes|went) on": "continues, resumes",
    r"(gives|gave|given) up": "drops, stops",
    r"unsays?": "overrides",
    r"what (is|was) (seen|found|known|lost|told)": "name the thing",
}


def without_code(text: str) -> str:
    return re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)


def prose(text: str) -> str:
    """A page without its code and the targets of its links."""
    text = re.sub(r"`[^`]*`", "`", without_code(text))
    return re.sub(r"\]\([^)]*\)", "]", text)


def faults(text: str) -> list[str]:
    """Idioms in a text, each with what to say instead."""
    text = " ".join(text.split())
    return [
        f"{found[0]!r}: say {better}, in {text[max(0, found.start() - 40) : found.end() + 20]!r}"
        for banned, better in BANNED.items()
        for found in re.finditer(rf"\b(?:{banned})(?!\w)", text, re.IGNORECASE)
    ]


def help_texts(command: Any, name: str) -> Iterator[tuple[str, str]]:
    """The help of a command, of its parameters, and of the commands below it."""
    yield name, command.help or ""
    for parameter in command.params:
        yield f"{name} {parameter.name}", getattr(parameter, "help", None) or ""
    for below, inner in getattr(command, "commands", {}).items():
        yield from help_texts(inner, f"{name} {below}")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_are_in_plain_english(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert not faults(prose(text))
    assert not [
        line
        for line in without_code(text).splitlines()
        if len(line) > LONGEST_LINE and not line.startswith("|")
    ]


def test_help_is_in_plain_english() -> None:
    texts = dict(help_texts(typer.main.get_command(app), "pliant"))
    found = {name: faults(text) for name, text in texts.items()}
    assert {name: said for name, said in found.items() if said} == {}


def test_idioms_are_found_as_whole_words() -> None:
    assert faults("a pose is told as doubtful")
    assert faults("compared with others,\nbeside\nCOLMAP")
    assert not faults("ground truth causally; they cannot be told apart")
    assert not faults(prose("`trajectory_causal.txt` and [this](places.md#what-is-seen)"))
