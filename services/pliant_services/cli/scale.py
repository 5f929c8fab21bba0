"""``pliant scale``: a result in metres, by a known length in the scene or inertial samples."""

from pathlib import Path
from typing import Annotated

import typer

from pliant.wording import shown


def _point(text: str) -> tuple[float, ...]:
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{shown(text)} is not a point: expected X,Y,Z") from None
    return x, y, z


def scale(
    result: Annotated[Path, typer.Argument(help="A result folder.")],
    points: Annotated[
        tuple[str, str, float] | None,
        typer.Option(
            "--points",
            metavar="X,Y,Z X,Y,Z METRES",
            help="Two points of the map and their distance; pick the points in report.html.",
        ),
    ] = None,
    marker: Annotated[
        float | None,
        typer.Option(
            "--marker",
            metavar="METRES",
            help="Side length of the ArUco or AprilTag markers in view.",
        ),
    ] = None,
    depth: Annotated[
        str | None,
        typer.Option(
            "--depth",
            metavar="SOURCE",
            help="Source of the run, if it has depth maps or a stereo pair.",
        ),
    ] = None,
    gps: Annotated[
        bool, typer.Option("--gps", help="Satellite fixes that came with the source of the run.")
    ] = False,
    imu: Annotated[
        str | None,
        typer.Option(
            "--imu",
            metavar="FILE",
            help="Inertial samples, whose clock may differ; `recorded`: those of the run's source.",
        ),
    ] = None,
) -> None:
    """Make a result metric: its files, its later exports, and runs that extend its map.

    Earlier exports stay in the old unit; those in its folder are listed, so you can repeat them.

    pliant scale results/desk --marker 0.08

    pliant scale results/desk --points 0.12,0.05,1.3 0.48,0.06,1.31 0.60

    pliant scale results/desk --depth path/to/desk

    pliant scale results/flight --gps

    pliant scale results/desk --imu gyro_accel.csv
    """
    from pliant.scale.command import Known, scale_result

    a_b = None if points is None else (_point(points[0]), _point(points[1]), points[2])
    known = Known(points=a_b, marker=marker, depth=depth, gps=gps, imu=imu)
    for line in scale_result(result, known):
        typer.echo(line)
