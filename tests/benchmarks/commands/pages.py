"""All tables of a page at once."""

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.commands.app import app, show


@app.command("all")
def everything(
    only: Annotated[str, typer.Option(help="Names of tables, with commas between [all].")] = "",
    data: Annotated[Path, typer.Option(help="Folder of the sequences.")] = Path("../shared/data"),
    raw: Annotated[Path, typer.Option("--raw", help="Folder of what the commands print.")] = Path(
        "results/tables"
    ),
    page: Annotated[Path, typer.Option(help="Page to write.")] = Path("docs/results.md"),
    run: Annotated[
        bool, typer.Option("--run/--no-run", help="Measure, or render the page only.")
    ] = True,
) -> None:
    """Measure the tables of docs/results.md and write them into the page.  All take seven hours.

    scripts/bench all --only seeds,meshing
    """
    from benchmarks.results_page import make, present_commit

    names = [name for name in only.split(",") if name]
    show(make(page, names, data=data, raw=raw, run=run, commit=present_commit()))
