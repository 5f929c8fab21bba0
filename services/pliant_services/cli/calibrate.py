"""``pliant calibrate``: the camera of a video, with a board or without."""

from pathlib import Path
from typing import Annotated, Literal

import typer


def calibrate(
    source: Annotated[
        str,
        typer.Argument(
            help="Video, folder of images or bag, as in `pliant run`.", show_default=False
        ),
    ] = "",
    board: Annotated[
        str | None,
        typer.Option(
            help="KIND:COLUMNSxROWS[:SQUARE_MM[:MARKER_MM[:DICTIONARY]]]: charuco:7x10 or "
            "chessboard:10x7, counted in squares. Without a board, the scene calibrates the "
            "camera."
        ),
    ] = None,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="Calibration file to write; a picture is written next to it."
        ),
    ] = Path("calib.yaml"),
    force: Annotated[bool, typer.Option("--force", help="Replace existing output.")] = False,
    lens: Annotated[
        Literal["radtan", "fisheye"],
        typer.Option(
            help="With a board: pinhole-radtan (k1 k2 p1 p2 k3), or fisheye (k1 to k4) for a very "
            "wide lens."
        ),
    ] = "radtan",
    fov: Annotated[
        float | None,
        typer.Option(help="Without a board: initial horizontal field of view in degrees."),
    ] = None,
    topic: Annotated[
        str, typer.Option(help="Image topic, for an MCAP file or ROS bag with several.")
    ] = "",
    mask: Annotated[
        Path | None,
        typer.Option(
            help="Mask image: black parts are ignored in all frames; or a folder with a mask per "
            "frame."
        ),
    ] = None,
    print_board: Annotated[
        Path | None,
        typer.Option(help="Write the board as a PDF in true size [charuco:7x10:25]."),
    ] = None,
) -> None:
    """Calibrate the camera of a video: focal length, centre, distortion, and their uncertainty.

    pliant calibrate --print-board board.pdf

    pliant calibrate board.mp4 --board charuco:7x10

    pliant calibrate board.mp4 --board chessboard:10x7 --output phone.yaml

    pliant calibrate anything.mp4

    pliant calibrate dashcam.mp4 --mask bonnet.png
    """
    from pliant.errors import ResultError
    from pliant_services.calibrate import board as boards

    if (source == "") == (print_board is None):
        raise typer.BadParameter("no source given: pass one, or --print-board FILE")
    if board is not None and fov is not None:
        raise typer.BadParameter("--fov is only for a source without --board")
    if print_board is not None:
        if print_board.suffix.lower() != ".pdf":
            raise ResultError(
                f"{print_board}: a board is written as PDF: use a name that ends in .pdf"
            )
        if print_board.exists() and not force:
            raise ResultError(f"{print_board} exists: choose another name, or --force")
        typer.echo(
            boards.print_board(boards.parse_board(board or boards.DEFAULT_BOARD), print_board)
        )
        return
    from pliant_services.calibrate import command

    command.check_file(output, source=source, mask=mask, force=force)
    if board is None:
        lines = command.calibrate_without_board(source, output, fov_deg=fov, topic=topic, mask=mask)
    else:
        lines = command.calibrate_with_board(
            source,
            boards.parse_board(board),
            output,
            lens="fisheye" if lens == "fisheye" else "pinhole-radtan",
            topic=topic,
            mask=mask,
        )
    for line in lines:
        typer.echo(line)
