"""Tables as Markdown, ready for the docs."""

from collections.abc import Iterable, Sequence


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    return "\n".join([markdown_header(header), *map(markdown_row, rows)])


def markdown_header(header: Sequence[str]) -> str:
    """The first two lines of a table whose rows follow one by one."""
    return "\n".join(markdown_row(line) for line in (header, ["---"] * len(header)))


def markdown_row(row: Sequence[str]) -> str:
    """One line of a table."""
    return "| " + " | ".join(row) + " |"
