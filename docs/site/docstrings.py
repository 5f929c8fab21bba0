"""Our docstrings as Markdown, for mkdocstrings."""

import re
from typing import Any

import griffe


class OurDocstrings(griffe.Extension):
    """Docstrings announce code by ``::``, and have <names> in their text."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Take the second colon away, and have <names> shown."""
        if obj.docstring:
            lines = [
                line if line.startswith("    ") else re.sub(r"::$", ":", line.replace("<", "&lt;"))
                for line in obj.docstring.value.splitlines()
            ]
            obj.docstring.value = "\n".join(lines)
