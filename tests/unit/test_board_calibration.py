"""A camera from rendered boards: what it was filmed with is found, or a line says why not."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from board_film import FISHEYE, LENS, film, texture
from typer.testing import CliRunner

from pliant.algorithms.board_calibration import (
    Board,
    BoardFinder,
    BoardView,
    calibrate,
    choose_views,
)
from pliant.algorithms.rectification import Lens
from pliant.datasets.calibration_files import read_calibration
from pliant.errors import CalibrationError, PliantError
from pliant_services.calibrate.board import DEFAULT_BOARD, parse_board
from pliant_services.calibrate.command import calibrate_with_board
from pliant_services.cli.commands import app

CHESSBOARD = Board(kind="chessboard", columns=9, rows=6)
CHARUCO = Board(kind="charuco", columns=7, rows=10)


@cache
def filmed(kind: str, lens: Lens, count: int = 16, tilt_deg: float = 35.0) -> list[Any]:
    board = CHESSBOARD if kind == "chessboard" else CHARUCO
    return list(film(board, lens, count, tilt_deg=tilt_deg))


@cache
def views_of(kind: str, lens: Lens) -> tuple[BoardView, ...]:
    finder = BoardFinder(CHESSBOARD if kind == "chessboard" else CHARUCO)
    return tuple(view for view in map(finder.find, filmed(kind, lens)) if view is not None)


def folder(path: Path, images: list[Any]) -> str:
    path.mkdir()
    for number, image in enumerate(images):
        cv2.imwrite(str(path / f"{number}.png"), image)
    return str(path)


@pytest.mark.parametrize("kind", ["chessboard", "charuco"])
@pytest.mark.parametrize("lens", [LENS, FISHEYE], ids=["radtan", "fisheye"])
def test_the_lens_is_found(kind: str, lens: Lens) -> None:
    views = views_of(kind, lens)
    model = "fisheye" if lens.model == "fisheye" else "pinhole-radtan"
    found = calibrate(views, lens.width, lens.height, model)
    assert found is not None
    assert found.rms_px < 0.25
    assert abs(np.log(found.lens.fx / lens.fx)) < 4.0 * found.focal_sigma
    assert found.focal_sigma < 0.003
    plane = np.stack(np.meshgrid(np.linspace(-0.35, 0.35, 8), np.linspace(-0.25, 0.25, 6)), axis=-1)
    # Where it looks is told less well than how wide: with a centre that is off it is turned a bit.
    shift = np.array([found.lens.cx - lens.cx, found.lens.cy - lens.cy])
    assert np.abs(shift).max() < 2.0
    apart = found.lens.project(plane) - lens.project(plane) - shift
    assert np.abs(apart).max() < 0.5


def test_a_view_that_is_wrong_is_left_out() -> None:
    views = list(views_of("chessboard", LENS))
    random = np.random.default_rng(3)
    views[2] = BoardView(views[2].corners, views[2].points_px + random.normal(0, 3, (40, 2)))
    found = calibrate(views, 640, 480, "pinhole-radtan")
    assert found is not None
    assert not found.used[2]
    assert found.used.sum() >= len(views) - 2
    assert abs(found.lens.fx - LENS.fx) < 1.0


def test_views_that_differ_are_chosen_and_the_sharpest_of_those_that_do_not() -> None:
    views = views_of("chessboard", LENS)[:4]
    shaken = [BoardView(view.corners, view.points_px + 1.0) for view in views]
    turned = [BoardView(view.corners, view.points_px[::-1]) for view in views]
    sharp = [0.5] * 4 + [0.6] * 4 + [0.4] * 4
    chosen = choose_views([*views, *shaken, *turned], sharp, CHESSBOARD, 640)
    assert chosen.tolist() == [4, 5, 6, 7]
    many = [BoardView(views[0].corners, views[0].points_px + 640 * k / 15.0) for k in range(100)]
    assert 20 <= len(choose_views(many, [0.5] * 100, CHESSBOARD, 640)) <= 40


def test_a_board_of_before_opencv_4_6_is_found() -> None:
    board = Board(kind="charuco", columns=6, rows=8)
    image = board.aruco(legacy=True).generateImage((480, 640), marginSize=40, borderBits=1)
    view = BoardFinder(board).find(image)
    assert view is not None
    np.testing.assert_array_equal(view.corners, board.corners)


def test_a_folder_of_images_becomes_a_calibration_with_a_picture(tmp_path: Path) -> None:
    source = folder(tmp_path / "board", filmed("charuco", LENS))
    output = tmp_path / "phone.yaml"
    command = ["calibrate", source, "--board", "charuco:7x10", "--output", str(output)]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert re.search(r"focal length 5[56]\d\.\d \+- 0\.\d+ px", done.output)
    assert "reprojection error 0." in done.output
    assert re.search(r"cover \d\d % of the image", done.output)
    calibration = read_calibration(output, (640, 480))
    assert abs(calibration.fx - LENS.fx) < 2.0
    assert calibration.focal_sigma == 0.0
    picture = cv2.imread(str(output.with_suffix(".png")))
    assert picture is not None
    assert picture.std() > 10.0
    before = output.read_bytes()
    again = CliRunner().invoke(app, command)
    assert "phone.yaml exists" in str(again.exception)
    assert output.read_bytes() == before


def test_what_a_mask_covers_is_no_board(tmp_path: Path) -> None:
    """A poster of the board at the edge of every image, as another board of the room would be."""
    images = [image.copy() for image in filmed("charuco", LENS)]
    for image in images:
        image[330:] = images[0][150:300]
    source, output = folder(tmp_path / "board", images), tmp_path / "phone.yaml"
    mask = np.full((480, 640), 255, np.uint8)
    mask[330:] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    command = ["calibrate", source, "--board", "charuco:7x10", "--output", str(output)]
    done = CliRunner().invoke(app, [*command, "--mask", str(tmp_path / "mask.png")])
    assert done.exit_code == 0, done.output + str(done.exception)
    assert abs(read_calibration(output, (640, 480)).fx - LENS.fx) < 3.0
    output.unlink()
    done = CliRunner().invoke(app, [*command, "--force"])
    assert done.exit_code != 0 or abs(read_calibration(output).fx - LENS.fx) > 10.0
    done = CliRunner().invoke(app, [*command, "--force", "--mask", str(tmp_path / "none.png")])
    assert "none.png: cannot be read" in str(done.exception)


REFUSED = [
    ("chessboard", "chessboard:8x5", "they show a chessboard of 9x6 squares: check --board"),
    ("chessboard", "charuco:7x10", "they show a chessboard of 9x6 squares"),
    ("charuco", "chessboard:10x7", "markers of 4x4: check"),
    ("charuco", "charuco:7x10:25:18:5x5_100", "they show 35 markers of 4x4"),
    ("blank", "charuco:7x10", "is in none of 16 frames: show the whole board"),
    ("few", "charuco:7x10", "with 4 different views; 6 are needed"),
    ("straight", "charuco:7x10", "the focal length is uncertain"),
]


@pytest.mark.parametrize(("shows", "board", "says"), REFUSED)
def test_what_is_no_calibration_is_one_line(
    tmp_path: Path, shows: str, board: str, says: str
) -> None:
    images = {
        "blank": lambda: [np.full((480, 640), 90, np.uint8)] * 16,
        "few": lambda: filmed("charuco", LENS)[:4] * 5,
        "straight": lambda: filmed("charuco", LENS, 12, 0.3),
    }.get(shows, lambda: filmed(shows, LENS)[:4])()
    source, output = folder(tmp_path / "board", images), tmp_path / "calib.yaml"
    with pytest.raises(CalibrationError) as caught:
        calibrate_with_board(source, parse_board(board), output, lens="pinhole-radtan", topic="")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(f"{source}: ")
    assert not output.exists()


@pytest.mark.parametrize(
    ("spelled", "says"),
    [
        ("7x10", "expected KIND:COLUMNSxROWS"),
        ("charuco:2x9", "too few squares"),
        ("chessboard:3x9", "use at least 4 per side"),
        ("charuco:7x10:25:30", "a marker must be smaller than its square"),
        ("charuco:7x10:2.5.1", "must be numbers, in mm"),
        ("charuco:7x10:25:18:9x9_50", "no dictionary 9x9_50: use "),
        ("charuco:12x12", "4x4_50 has 50 markers, but the board needs 72"),
    ],
)
def test_boards_that_cannot_be_are_refused(spelled: str, says: str) -> None:
    with pytest.raises(CalibrationError, match=re.escape(says)):
        parse_board(spelled)


@pytest.mark.parametrize(
    "spelled", [DEFAULT_BOARD, "chessboard:9x6:30", "charuco:5x7:20:14:6x6_50"]
)
def test_the_printed_board_is_the_one_that_is_looked_for(tmp_path: Path, spelled: str) -> None:
    """What the PDF's rectangles fill, 4 px a mm: the board, and in its true size."""
    path = tmp_path / "board.pdf"
    done = CliRunner().invoke(app, ["calibrate", "--print-board", str(path), "--board", spelled])
    assert done.exit_code == 0, done.output
    text = path.read_bytes().decode("ascii")
    start = int(re.findall(r"startxref\n(\d+)", text)[0])
    assert text[start:].startswith("xref")
    width, height = (
        float(v) / 72.0 * 25.4 for v in re.findall(r"MediaBox \[0 0 (\S+) (\S+)\]", text)[0]
    )
    page = np.full((round(4 * height), round(4 * width)), 255, np.uint8)
    for grey, *numbers in re.findall(r"(\d) g (\S+) (\S+) (\S+) (\S+) re f", text):
        x, y, w, h = (float(number) / 72.0 * 25.4 for number in numbers)
        top = height - y - h
        rows = slice(round(4 * top), round(4 * (top + h)))
        page[rows, round(4 * x) : round(4 * (x + w))] = 255 * int(grey)
    printed = parse_board(spelled)
    view = BoardFinder(printed.board).find(page)
    assert view is not None
    assert len(view.corners) == len(printed.board.corners)
    steps = np.linalg.norm(np.diff(view.points_px, axis=0), axis=1) / 4.0
    assert np.median(steps) == pytest.approx(printed.square_mm, abs=0.1)
    if printed.board.kind == "charuco":  # and it is OpenCV's, in each of its cells
        image = texture(printed.board)
        assert BoardFinder(printed.board).find(image) is not None


def test_wrong_use(tmp_path: Path) -> None:
    for arguments, says in (
        ([], "no source given: pass one, or --print-board FILE"),
        (["clip.mp4", "--board", "charuco:7x10", "--fov", "60"], "--fov is only for a source"),
        (["--print-board", str(tmp_path / "board.svg")], "is written as PDF"),
        (["clip.mp4", "--output", str(tmp_path)], "is a folder: name a file"),
    ):
        done = CliRunner().invoke(app, ["calibrate", *arguments])
        assert done.exit_code != 0
        assert says in done.output + str(done.exception)
    with pytest.raises(PliantError, match="no such file"):
        calibrate_with_board(
            "nowhere.mp4", parse_board(DEFAULT_BOARD), tmp_path / "c.yaml", lens="fisheye", topic=""
        )


def test_another_size_is_another_camera(tmp_path: Path) -> None:
    """A calibration is for the size of most images in the folder: none of another size is taken."""
    half = replace(LENS, width=320, height=240, fx=280.0, fy=279.0, cx=160.0, cy=120.0)
    images = [*filmed("charuco", LENS)[:2], *filmed("charuco", half, 8)]
    source = folder(tmp_path / "board", images)
    output = tmp_path / "c.yaml"
    calibrate_with_board(source, parse_board("charuco:7x10"), output, lens="fisheye", topic="")
    found = read_calibration(output, (320, 240))
    assert found.fx == pytest.approx(half.fx, rel=0.02)
