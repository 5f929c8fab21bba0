"""Pages that are made when the site is built: what the program says of itself, and what lies
beside docs/ in the repository.  A hook of mkdocs (mkdocs.yml)."""

import html
import inspect
import json
import posixpath
import re
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import typer
from mkdocs.structure.files import File, Files, InclusionLevel

import pliant
from pliant.algorithms.arrays import array_fields
from pliant.config import describe
from pliant.messages.codec import scalars
from pliant.messages.topics import TOPICS, Topic, status
from pliant.messages.types import Header
from pliant_services.cli.commands import app
from pliant_services.cli.groups import GROUPS, grouped_options
from pliant_services.processes import PROCESSES

ROOT = Path(__file__).parents[2]
REPOSITORY = "repository/"
"""Where in the site the files beside docs/ are."""
_BESIDE = ("CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")
_NOT_SEARCHED = "---\nsearch:\n  exclude: true\n---\n\n"
_PYTHON = (
    "What `import pliant` gives ([examples](../python.md)), what that returns, and its errors. "
    "`F64` is a numpy array of float64, `F32` of float32, `U8` of uint8, `I64` of int64."
)
_RETURNED = (
    "pliant.trajectory.Trajectory",
    "pliant.api.result.Keyframe",
    "pliant.algorithms.meshing.mesh_blocks.TriangleMesh",
    "pliant.errors",
)
_LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#\s]+)")


def on_files(files: Files, *, config: Any) -> Files:
    """Add the pages of the reference, and what is linked to of the rest of the repository."""
    for name, make in _REFERENCE.items():
        files.append(File.generated(config, f"reference/{name}.md", content=make()))
    for notebook in (ROOT / "docs").glob("*.ipynb"):
        files.append(File.generated(config, f"{notebook.stem}.md", content=_notebook(notebook)))
    texts = [page.content_string for page in files.documentation_pages() if page.abs_src_path]
    linked = {path for text in texts for path in _beside_docs(text, "docs/")}
    for path in sorted({*_BESIDE, *linked}):
        text = (ROOT / path).read_text(encoding="utf-8")
        if not path.endswith(".md"):
            text = f"{_NOT_SEARCHED}# {path}\n\n```{path.rpartition('.')[2]}\n{text}\n```\n"
        page = File.generated(config, _in_site(path), content=text)
        page.inclusion = InclusionLevel.INCLUDED if path in _BESIDE else InclusionLevel.NOT_IN_NAV
        files.append(page)
    return files


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Files) -> str:
    """Links to files beside docs/ lead to their pages."""
    uri = page.file.src_uri
    own = uri.removeprefix(REPOSITORY) if uri.startswith(REPOSITORY) else f"docs/{uri}"

    def of_site(link: re.Match[str]) -> str:
        path = _target(link[0], own)
        exists = (ROOT / path).is_file()
        return posixpath.relpath(_in_site(path), posixpath.dirname(uri)) if exists else link[0]

    return re.sub(_LINK, of_site, markdown)


def _target(link: str, page: str) -> str:
    """What a link of a page means, both as paths of the repository."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), link))


def _in_site(path: str) -> str:
    """Where a file of the repository is in the site."""
    if path.startswith("docs/"):
        return path.removeprefix("docs/").replace(".ipynb", ".md")
    return REPOSITORY + path + ("" if path.endswith(".md") else ".md")


def _beside_docs(text: str, page: str) -> set[str]:
    paths = {_target(link[0], page) for link in re.finditer(_LINK, text)}
    return {p for p in paths if not p.startswith(("docs/", "..")) and (ROOT / p).is_file()}


def _notebook(path: Path) -> str:
    """The cells of a notebook, code as code."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    texts = [("".join(cell["source"]), cell["cell_type"] == "code") for cell in cells]
    return "\n\n".join(f"```python\n{text}\n```" if code else text for text, code in texts)


def _commands() -> str:
    """Every command as the command line has it."""
    group: Any = typer.main.get_command(app)
    parts = ["# Commands", "What `--help` of each says.", *_prose(group.help)]
    for heading in GROUPS:
        parts.append(f"## {heading}")
        for name, command in group.commands.items():
            if command.rich_help_panel == heading:
                parts += _command(f"pliant {name}", command)
    return "\n\n".join(parts)


def _command(name: str, command: Any) -> Iterator[str]:
    yield f"### {name}"
    yield from _prose(command.help)
    below: dict[str, Any] = getattr(command, "commands", {})
    for each in below:
        yield from _command(f"{name} {each}", below[each])
    context = typer.Context(command, info_name=name)
    for heading, records in grouped_options(command, context).items():
        rows = [(_code(option), _plain(text)) for option, text in records]
        if not below:
            yield _table((heading, ""), rows)


def _prose(text: str) -> Iterator[str]:
    """Paragraphs of a help text; commands among them as code."""
    paragraphs = inspect.cleandoc(text).split("\n\n")
    for is_example, some in groupby(paragraphs, lambda p: p.strip().startswith("pliant ")):
        if is_example:
            yield "```sh\n" + "\n".join(p.strip() for p in some) + "\n```"
        else:
            yield "\n\n".join(_plain(p) for p in some)


def _parameters() -> str:
    """Every parameter of a run, with its default."""
    parts = ["# Parameters"]
    parts.append(
        "`pliant run --config FILE` takes them from YAML, `--set KEY=VALUE` sets one. "
        "`pliant config` prints and checks them, `pliant config --explain` says what is here."
    )
    for group, rows in groupby(describe(), lambda row: row[0].rpartition(".")[0]):
        parts.append(f"## {group}" if group else "## Of the whole run")
        parts.append(
            _table(
                ("key", "default", "meaning"),
                [(_code(key), _code(default), _plain(text)) for key, default, text in rows],
            )
        )
    return "\n\n".join(parts)


def _messages() -> str:
    """Every topic and its message."""
    parts = [
        "# Messages",
        "Every stream between the services, from the table of topics; the recording has the same "
        "messages under the same names ([how they are written](../recording.md#the-file)). "
        "A letter in a shape is a size: the same letter, the same size within a message.",
        "All messages have these fields:",
        *_message(Header, without=set()),
    ]
    everywhere = {field.name for field in fields(Header)}
    for topic in (*TOPICS, status("SERVICE")):
        parts += [f"## {topic.key}", _topic_text(topic)]
        parts += _message(topic.message, without=everywhere)
    return "\n\n".join(parts)


def _topic_text(topic: Topic) -> str:
    senders = [p.name for p in PROCESSES if topic in p.outputs]
    readers = [p.name for p in PROCESSES if topic in p.inputs]
    perhaps = [p.name for p in PROCESSES if topic in p.optional]
    facts = [f"`{topic.message.__name__}`"]
    facts.append("one for every frame" if topic.per_frame else "when there is something to tell")
    facts += [f"from {', '.join(senders)}"] if senders else []
    facts += [f"read by {', '.join(readers)}"] if readers else []
    facts += [f"by {', '.join(perhaps)} where it is there"] if perhaps else []
    facts.append("recorded" if topic.logged else "not recorded")
    facts += [] if topic.deterministic else ["not the same in every run"]
    facts.append(f"at most {topic.max_bytes >> 20} MiB")
    return "; ".join(facts) + "."


def _message(message: type[Header], without: set[str]) -> Iterator[str]:
    """What a message says of itself, and a table of its fields."""
    types = {name: _type_name(kind) for name, kind in scalars(message).items()}
    for array in array_fields(message):
        types[array.name] = f"{array.dtype} ({', '.join(map(str, array.shape))})"
    meanings: dict[str, str] = {}
    for kind in message.__mro__:
        if is_dataclass(kind) and not (without and kind is Header):
            for paragraph in inspect.cleandoc(kind.__doc__ or "").split("\n\n"):
                prose, *said = _said_of_fields(paragraph, [field.name for field in fields(message)])
                if prose.strip():
                    yield _plain(prose)
                meanings.update(said)
    rows = [
        (_code(field.name), _code(types[field.name]), _plain(meanings.get(field.name, "")))
        for field in fields(message)
        if field.name not in without
    ]
    yield _table(("field", "type", "meaning"), rows)


def _said_of_fields(paragraph: str, names: list[str]) -> Iterator[Any]:
    """The text before the first field, and then each (field, what is said of it)."""
    name = rf"(?:{'|'.join(names)})(?: \([^)]*\))?"
    before, *rest = re.split(rf"(?<!\S)({name}(?:(?:,| \.\.\.)\s+{name})*):\s", paragraph)
    yield before
    for told, text in zip(rest[::2], rest[1::2], strict=True):
        some = re.findall(rf"(?<!\w)({'|'.join(names)})(?!\w)", re.sub(r"\(.*?\)", "", told))
        if "..." in told:  # and those between
            some = names[names.index(some[0]) : names.index(some[-1]) + 1]
        yield from ((each, text) for each in some)


def _type_name(kind: Any) -> str:
    return kind.__name__ if isinstance(kind, type) and not hasattr(kind, "__args__") else str(kind)


def _python() -> str:
    """What ``import pliant`` gives, by mkdocstrings."""
    first = ["run", "open", "follow", "load_map", "Result", "Slam"]
    names = [*first, *(name for name in sorted(pliant._WHERE) if name not in first)]
    parts = ["# Python", _PYTHON]
    parts += [f"::: pliant.{name}" for name in names]
    parts += [f"::: {name}" for name in _RETURNED]
    return "\n\n".join(parts)


_REFERENCE: dict[str, Callable[[], str]] = {
    "commands": _commands, "parameters": _parameters, "messages": _messages, "python": _python,
}  # fmt: skip


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _code(text: str) -> str:
    return f"`` {text} ``" if text else ""


def _plain(text: str) -> str:
    """Text as Markdown that shows it as it is, but for ``code``."""
    words = re.split(r"``(.+?)``|`(.+?)`", " ".join(text.split()))
    shown = ""
    for place, word in enumerate(words):
        if word is not None:
            escaped = re.sub(r"([\\*_\[\]|])", r"\\\1", html.escape(word, quote=False))
            shown += escaped if place % 3 == 0 else _code(word)
    return shown
