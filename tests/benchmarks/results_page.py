"""Makes docs/results.md: runs the commands of its tables, keeps what they print, and puts it there.

The page has a table between ``<!-- bench NAME -->`` and ``<!-- end -->``, with its commands and the
commit at which they ran.  A table whose raw results are not in the folder stays as it is.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.results_tables import TABLES, Output, Table
from pliant.errors import PliantError

_ROOT = Path(__file__).parents[2]
_PROGRAMS = {"scripts/bench": "benchmarks", "pliant": "pliant_services.cli"}
_PREPARES = "pliant run"
_WIDTH = 140


def make(
    page: Path, only: Sequence[str], *, data: Path, raw: Path, run: bool, commit: str
) -> Iterator[str]:
    """Measure tables, and render all that have raw results.

    only: names of tables; none: all.    data: the folder of the sequences.    raw: that of the
    results: a table that has been measured at this commit is not measured again.    run: or only
    render the page.    commit: of the code, "-dirty" if it differs.  Yields what is done.

    Raises PliantError.
    """
    if unknown := sorted(set(only) - set(TABLES)):
        raise PliantError(f"--only {unknown[0]}: choose {', '.join(TABLES)}")
    for name in [name for name in TABLES if not only or name in only] if run else []:
        file = raw / f"{name}.json"
        clean = not commit.endswith("-dirty")
        if clean and file.exists() and json.loads(file.read_text())["commit"] == commit:
            yield f"{name}: already measured at {commit}"
            continue
        yield f"{name}: about {TABLES[name].minutes} minutes"
        start = time.monotonic()
        outputs = [_output(command, data, raw) for command in TABLES[name].commands]
        content = {"commit": commit, "date": time.strftime("%Y-%m-%d"), "outputs": outputs}
        file.write_text(json.dumps(content, indent=1) + "\n")
        yield f"{name}: {(time.monotonic() - start) / 60.0:.1f} minutes"
    for picture in raw.glob("*.png"):
        shutil.copy(picture, page.parent)
    page.write_text(rendered(page.read_text(), raw))


def rendered(page: str, raw: Path) -> str:
    """The page with the tables of the raw results."""

    def block(found: re.Match[str]) -> str:
        name = found[1]
        if name not in TABLES:
            raise PliantError(f"the page has a table {name}: choose {', '.join(TABLES)}")
        file = raw / f"{name}.json"
        if not file.exists():
            return found[0]
        body = _body(TABLES[name], json.loads(file.read_text()))
        return f"<!-- bench {name} -->\n{body}<!-- end -->"

    return re.sub(r"<!-- bench ([\w-]+) -->\n.*?<!-- end -->", block, page, flags=re.DOTALL)


def commands_block(table: Table) -> str:
    """The commands as the page shows them."""
    lines: list[str] = []
    for command in table.commands:
        whole = re.sub(r"(--\S+) (?!-)", "\\1\0", command)  # an option stays with its value
        parts = textwrap.wrap(whole, _WIDTH, break_long_words=False, break_on_hyphens=False)
        lines.append(" \\\n    ".join(parts).replace("\0", " "))
    return "\n".join(["```sh", *lines, "```"])


def _body(table: Table, content: dict[str, Any]) -> str:
    outputs = [Output(each["command"], each["text"]) for each in content["outputs"]]
    shown = table.shown([each for each in outputs if not each.command.startswith(_PREPARES)])
    made = f"*Commit {content['commit']}, {content['date']}.*"
    return f"{commands_block(table)}\n\n{made}\n\n{shown}\n\n"


def _output(command: str, data: Path, raw: Path) -> dict[str, str]:
    """Run one command in the folder of raw results.  Raises PliantError where it fails."""
    program, *words = shlex.split(command)
    places = {path.name: path for path in (*data.glob("*"), *data.glob("*/*")) if path.is_dir()}
    arguments = [str(places[word].resolve()) if word in places else word for word in words]
    paths = [_ROOT / name for name in ("shared", "services", "tests", "tests/replay")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    raw.mkdir(parents=True, exist_ok=True)
    done = subprocess.run(
        [sys.executable, "-m", _PROGRAMS[program], *arguments],
        capture_output=True,
        text=True,
        cwd=raw,
        env=environment,
    )
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise PliantError(f"{command}: exit code {done.returncode}: {said}")
    return {"command": command, "text": done.stdout}


def present_commit() -> str:
    """Of the code, as ``git describe`` has it.  Raises PliantError outside of a checkout."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=7"]
    done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True)
    if done.returncode:
        raise PliantError(f"git: {done.stderr.strip()}")
    return done.stdout.strip()
