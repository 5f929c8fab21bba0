"""A page of a PDF with filled rectangles and lines of words, at its true size (ISO 32000-1)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pliant.formats.text import write_bytes

_POINTS_PER_MM = 72.0 / 25.4


@dataclass(frozen=True)
class Rectangle:
    """Filled, in mm from the top left of the page; later ones lie on earlier ones."""

    x: float
    y: float
    width: float
    height: float
    white: bool = False


@dataclass(frozen=True)
class Words:
    """A line of ASCII in Helvetica; (x, y): where its baseline begins, mm from the top left."""

    x: float
    y: float
    text: str
    size_mm: float = 3.0


def write_page(path: Path, width: float, height: float, marks: Sequence[Rectangle | Words]) -> None:
    """Write a page of that size in mm; viewers shall not scale it.  Raises ResultError."""
    content = "\n".join(_drawn(mark, height) for mark in marks).encode("ascii", "replace")
    size = f"{width * _POINTS_PER_MM:.4f} {height * _POINTS_PER_MM:.4f}"
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {size}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        f"<< /Length {len(content)} >>\nstream\n".encode() + content + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    data, places = b"%PDF-1.6\n", list[int]()
    for number, each in enumerate(objects, start=1):
        places.append(len(data))
        data += f"{number} 0 obj\n".encode() + each + b"\nendobj\n"
    table = "".join(f"{place:010d} 00000 n \n" for place in places)
    tail = (
        f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}"
        f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{len(data)}\n%%EOF\n"
    )
    write_bytes(path, data + tail.encode())


def _drawn(mark: Rectangle | Words, page_height: float) -> str:
    """The mark's operators.  A PDF counts from the bottom left, in points."""
    if isinstance(mark, Words):
        text = mark.text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
        place = _points(mark.x, page_height - mark.y)
        return f"0 g BT /F1 {_points(mark.size_mm)} Tf {place} Td ({text}) Tj ET"
    bottom = page_height - mark.y - mark.height
    return f"{int(mark.white)} g {_points(mark.x, bottom, mark.width, mark.height)} re f"


def _points(*values_mm: float) -> str:
    return " ".join(f"{value * _POINTS_PER_MM:.4f}" for value in values_mm)
