"""Our docstrings as Markdown, for mkdocstrings."""

import re
from typing import Any

import griffe


class OurDocstrings(griffe.Extension):
    """Docstrings announce code by ``::``, have <names> in their text, and gaps between fields."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Make the text of a docstring Markdown, and leave its code."""
        if obj.docstring:
            lines = obj.docstring.value.splitlines()
            shown = [line if line.startswith("    ") else _as_markdown(line) for line in lines]
            text = "\n".join(shown)
            obj.docstring.value = re.sub(r"(?<=\.)\n(?=\w[\w ,()]*: )", "<br>\n", text)


def _as_markdown(line: str) -> str:
    line = re.sub(r"::$", ":", line.replace("<", "&lt;"))
    return re.sub(r"(?<=\S) {3,}(?=\S)", "<br>", line)
