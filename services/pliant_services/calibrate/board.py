"""How a board is named on the command line, and the page that it is printed from."""

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pliant.algorithms.board_calibration import DICTIONARIES, Board
from pliant.errors import CalibrationError
from pliant.formats.pdf import Rectangle, Words, write_page

DEFAULT_BOARD = "charuco:7x10:25"
"""Fits A4 and US letter."""
_SPELLED = re.compile(
    r"(?P<kind>chessboard|charuco):(?P<columns>\d+)x(?P<rows>\d+)"
    r"(:(?P<square>[\d.]+)(:(?P<marker>[\d.]+)(:(?P<dictionary>\w+))?)?)?"
)
_LEAST_CORNERS = 8
_PAPERS_MM = ((210.0, 297.0), (297.0, 210.0), (297.0, 420.0), (420.0, 297.0))
_MARGIN_MM = 8.0
_FOOT_MM = 14.0
"""Height of the words and the ruler below the board."""
_RULER_MM = 100.0


@dataclass(frozen=True)
class PrintedBoard:
    """A board and the side of its squares.  spelled: as the user did."""

    board: Board
    square_mm: float
    spelled: str


def parse_board(spelled: str) -> PrintedBoard:
    """``KIND:COLUMNSxROWS[:SQUARE_MM[:MARKER_MM[:DICTIONARY]]]``.  Raises CalibrationError."""

    def refused(why: str) -> CalibrationError:
        return CalibrationError(f"--board {spelled}: {why}")

    match = _SPELLED.fullmatch(spelled)
    if match is None:
        raise refused(
            "expected KIND:COLUMNSxROWS[:SQUARE_MM[:MARKER_MM[:DICTIONARY]]], such as "
            "charuco:7x10:25 or chessboard:10x7 (squares, not inner corners)"
        )
    columns, rows = int(match["columns"]), int(match["rows"])
    try:
        square = float(match["square"] or 25.0)
        marker = float(match["marker"] or 0.75 * square)
    except ValueError:
        raise refused("sizes of squares and markers must be numbers, in mm") from None
    least = 4 if match["kind"] == "chessboard" else 3
    if min(columns, rows) < least or (columns - 1) * (rows - 1) < _LEAST_CORNERS:
        raise refused(
            f"too few squares: use at least {least} per side, and {_LEAST_CORNERS} inner corners"
        )
    if not 0.0 < marker < square <= 1000.0:
        raise refused("a marker must be smaller than its square, and a square at most 1000 mm")
    dictionary = (match["dictionary"] or "4x4_50").lower()
    if match["kind"] == "chessboard":
        return PrintedBoard(Board(kind="chessboard", columns=columns, rows=rows), square, spelled)
    if dictionary not in DICTIONARIES:
        raise refused(f"no dictionary {dictionary}: use {', '.join(sorted(DICTIONARIES))}")
    has = len(cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary]).bytesList)
    if columns * rows // 2 > has:
        raise refused(
            f"{dictionary} has {has} markers, but the board needs {columns * rows // 2}: use "
            "another dictionary"
        )
    board = Board(
        kind="charuco",
        columns=columns,
        rows=rows,
        marker_share=marker / square,
        dictionary=dictionary,
    )
    return PrintedBoard(board, square, spelled)


def print_board(printed: PrintedBoard, path: Path) -> str:
    """Write the page; returns what to do with it.  Raises ResultError."""
    board, square = printed.board, printed.square_mm
    width, height = board.columns * square, board.rows * square
    needs = width + 2.0 * _MARGIN_MM, height + _MARGIN_MM + _FOOT_MM
    page = next((p for p in _PAPERS_MM if p[0] >= needs[0] and p[1] >= needs[1]), needs)
    left, top = 0.5 * (page[0] - width), 0.5 * (page[1] - needs[1]) + _MARGIN_MM
    marks: list[Rectangle | Words] = [
        Rectangle(
            left + r.x * square, top + r.y * square, r.width * square, r.height * square, r.white
        )
        for r in black_and_white(board)
    ]
    foot = top + height + 6.0
    marks.append(Rectangle(left, foot, min(_RULER_MM, width), 0.5))
    ruler = f"{min(_RULER_MM, width):g} mm if printed at 100 %"
    marks.append(Words(left, foot + 4.0, f"pliant calibrate --board {printed.spelled}    {ruler}"))
    write_page(path, *page, marks)
    return (
        f"{path}: {printed.spelled} on {page[0]:g}x{page[1]:g} mm; print it at 100 %, and glue it "
        "to something flat and stiff"
    )


def black_and_white(board: Board) -> list[Rectangle]:
    """The board in squares from its top left: what is black, and what is white again on it."""
    odd = np.indices((board.rows, board.columns)).sum(axis=0) % 2
    marks = [Rectangle(float(x), float(y), 1.0, 1.0) for y, x in np.argwhere(odd == 0)]
    if board.kind == "chessboard":
        return marks
    aruco = board.aruco()
    dictionary = aruco.getDictionary()
    cells = int(dictionary.markerSize) + 2
    for number, corners in zip(np.ravel(aruco.getIds()), aruco.getObjPoints(), strict=True):
        x, y, _ = np.asarray(corners, float).min(axis=0)
        marks.append(Rectangle(x, y, board.marker_share, board.marker_share))
        image = dictionary.generateImageMarker(int(number), cells, borderBits=1)
        cell = board.marker_share / cells
        marks += [
            Rectangle(x + column * cell, y + row * cell, cell, cell, white=True)
            for row, column in np.argwhere(np.asarray(image) > 0)
        ]
    return marks
