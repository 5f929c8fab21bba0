"""Pages, ``--help``, docstrings and comments use the words of the field, in readable lengths."""

import ast
import inspect
import io
import re
import tokenize
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest
import typer
from benchmarks.__main__ import app as bench

from pliant_services.cli.commands import app

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
LONGEST_LINE = 150  # characters, outside of tables and code
LONGEST_SENTENCE = 40  # words of two letters and more, in docstrings and comments
PACKAGES = sorted(
    {
        file.parent
        for product in ("shared/pliant", "services/pliant_services")
        for file in (ROOT / product).rglob("*.py")
    }
)

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
    r"nobody": "name the subject",
    r"(?<!ground[ -])truth": "ground truth",
    r"(goes|went) on": "continues, resumes",
    r"(gives|gave|given) up": "drops, stops",
    r"unsays?": "overrides",
    r"what (is|was) (seen|found|known|lost|told)": "name the thing",
    r"(is|are|was|were|be|being) said": "is given, reported, configured",
    r"says? (of|nothing)": "name the subject; has no effect",
    r"somebody": "name the subject",
    r"so many(?! \w+ that| that)": "this many, that many",
}

ANY_BANNED = re.compile(rf"\b(?:{'|'.join(BANNED)})(?!\w)", re.IGNORECASE)


def without_code(text: str) -> str:
    return re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)


def prose(text: str) -> str:
    """A page without its code and the targets of its links."""
    text = re.sub(r"`[^`]*`", "`", without_code(text))
    return re.sub(r"\]\([^)]*\)", "]", text)


def faults(text: str) -> list[str]:
    """Idioms in a text, each with what to say instead."""
    text = " ".join(text.split())
    if not ANY_BANNED.search(text):
        return []
    return [
        f"{found[0]!r}: say {better}, in {text[max(0, found.start() - 40) : found.end() + 20]!r}"
        for banned, better in BANNED.items()
        for found in re.finditer(rf"\b(?:{banned})(?!\w)", text, re.IGNORECASE)
    ]


@lru_cache(maxsize=1)
def strings(source: str) -> tuple[list[str], list[str]]:
    """Docstrings, those of constants among them, and all other constant texts of a file."""
    docstrings: dict[int, str] = {}
    others: dict[int, str] = {}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            docstrings[id(node.value)] = str(node.value.value)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            others[id(node)] = node.value
    return (
        [inspect.cleandoc(text) for text in docstrings.values()],
        [text for key, text in others.items() if key not in docstrings],
    )


def descriptions(source: str) -> Iterator[str]:
    """Docstrings, and blocks of comments."""
    yield from strings(source)[0]
    block: list[str] = []
    last = 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            if token.start[0] != last + 1 or token.line.lstrip()[0] != "#":
                yield "\n".join(block)
                block = []
            block.append(token.string.lstrip("# "))
            last = token.start[0]
    yield "\n".join(block)


def messages(source: str) -> list[str]:
    """Texts of three words and more that are no docstrings or pages: mostly for users."""
    return [text for text in strings(source)[1] if "<" not in text and len(text.split()) > 2]


def words_of(description: str) -> str:
    """A docstring or comment without formulas, examples, quotations and the names of fields."""
    lines = [line for line in description.splitlines() if not line.startswith("    ")]
    text = re.sub(r"``.*?``|`[^`]*`|\"[^\"]*\"", "`", "\n".join(lines), flags=re.DOTALL)
    return re.sub(r"(?:^| {2,})[\w.]+(?:, [\w.]+)*: ", ". ", text, flags=re.MULTILINE)


def long_sentences(text: str) -> list[str]:
    """Sentences of more words than are read at once."""
    text = re.sub(r"\n\s*(?:\n|[-*] )", ". ", text)
    sentences = re.split(r"[.:;!?](?:\s|$)", " ".join(text.split()))
    return [each for each in sentences if len(re.findall(r"[A-Za-z]{2,}", each)) > LONGEST_SENTENCE]


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
    texts |= dict(help_texts(typer.main.get_command(bench), "scripts/bench"))
    found = {name: faults(text) for name, text in texts.items()}
    assert {name: said for name, said in found.items() if said} == {}


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.name)
def test_docstrings_comments_and_messages_are_in_plain_english(package: Path) -> None:
    found: dict[str, list[str]] = {}
    for file in sorted(package.glob("*.py")):
        source = file.read_text(encoding="utf-8")
        texts = [words_of(text) for text in descriptions(source)]
        said = [each for text in [*texts, *messages(source)] for each in faults(text)]
        found[file.name] = said + [each for text in texts for each in long_sentences(text)]
    assert {name: said for name, said in found.items() if said} == {}


def test_messages_are_no_docstrings() -> None:
    source = "def f(n):\n    'Told of it.'\n    raise ValueError(f'{n} is told as wrong')\n"
    assert [*messages(source)] == [" is told as wrong"]


def test_descriptions_are_read_without_their_code() -> None:
    doc = 'def f():\n    """A.\n\n    told: of a pose.  Kind "causal".\n    """\n'
    source = doc + "    # told\n    # so\n"
    texts = [*descriptions(source)]
    assert "told\nso" in texts
    assert [words_of(text) for text in texts if faults(words_of(text))] == ["told\nso"]
    assert long_sentences("word " * 41)
    assert not long_sentences("word " * 40 + ". " + "word " * 40)


def test_idioms_are_found_as_whole_words() -> None:
    assert faults("a pose is told as doubtful")
    assert faults("compared with others,\nbeside\nCOLMAP")
    assert not faults("ground truth causally; they cannot be told apart")
    assert not faults(prose("`causal.txt` and [this](places.md#what-is-seen)"))


def test_names_of_tests_are_in_plain_english() -> None:
    idioms = r"_(told|tells?|asked|asks|says?|whoever|nobody|somebody|go(es)?_on|carried_off)(_|$)"
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        names = re.findall(r"def (test_\w+)", path.read_text(encoding="utf-8"))
        assert not [name for name in names if re.search(idioms, name)], path
