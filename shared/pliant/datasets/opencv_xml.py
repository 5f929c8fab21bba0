"""OpenCV's FileStorage as XML, under the keys that its YAML has."""

from typing import Any
from xml.etree import ElementTree

from pliant.errors import CalibrationError
from pliant.wording import shortened

_ROOT = "opencv_storage"


def is_xml(text: str) -> bool:
    """Whether it begins as XML does."""
    return text.lstrip().startswith(("<?xml", f"<{_ROOT}"))


def keys_of_xml(text: str) -> dict[str, Any]:
    """The values of a file by key; raises CalibrationError if it is not OpenCV's."""
    if "<!" in text.replace("<!--", ""):  # entities expand without a limit; OpenCV writes none
        raise CalibrationError("XML with declarations: OpenCV's FileStorage has none")
    try:
        root = ElementTree.fromstring(text.strip().encode())
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise CalibrationError(f"not XML: {shortened(str(error))}") from None
    if root.tag != _ROOT:
        raise CalibrationError(
            f"XML of another program (<{shortened(root.tag)}>): only OpenCV's is supported; "
            "export the calibration for OpenCV or COLMAP"
        )
    return {element.tag: _value(element) for element in root}


def _value(element: ElementTree.Element) -> Any:
    """A number, a text, or a matrix as YAML has it: keys with ``data``."""
    if len(element):
        return {child.tag: _value(child) for child in element}
    words = (element.text or "").split()
    if element.tag == "data" or len(words) > 1:
        numbers = [_number(word) for word in words]
        return numbers if all(isinstance(each, float) for each in numbers) else element.text
    return _number(words[0].strip('"')) if words else ""


def _number(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word
