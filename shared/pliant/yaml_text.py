"""YAML from anywhere, read with a limit on what it expands to.

Aliases make a few hundred bytes stand for 9^9 values: harmless as they are read, as the values are
shared, but not once they are printed or walked through.
"""

from typing import Any

import yaml

_MOST_VALUES = 1_000_000
_DEEPEST = 100


class YamlError(ValueError):
    """The text is no YAML, or one that is not read: a line without the name of the file."""


def load_yaml(text: str) -> Any:
    """The values in a YAML text, None for an empty one.

    Raises YamlError, also for more than a million values with aliases written out, and for
    aliases inside of themselves.
    """
    try:
        loader = yaml.SafeLoader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        if _size(node, {}, 0) > _MOST_VALUES:
            raise YamlError(f"its aliases stand for more than {_MOST_VALUES} values")
        return loader.construct_document(node)
    except YamlError:
        raise
    except yaml.YAMLError as error:
        raise YamlError(_line(error)) from None
    except RecursionError:
        raise YamlError("it is nested too deeply") from None
    except Exception as error:  # PyYAML's constructors raise many kinds on tags with odd values
        raise YamlError(f"a value does not fit its tag ({_line(error)})") from None


def _size(node: yaml.Node, known: dict[int, int], depth: int) -> int:
    """How many values a node stands for, aliases written out."""
    if depth > _DEEPEST:
        raise YamlError("it is nested too deeply, or in itself")
    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in known:
        children: list[yaml.Node] = []
        for child in node.value:
            children += child if isinstance(child, tuple) else [child]
        known[id(node)] = 1 + sum(_size(child, known, depth + 1) for child in children)
    return known[id(node)]


def _line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 200 else f"{text[:197]}..."
