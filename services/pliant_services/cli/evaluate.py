"""``pliant eval``: a result against ground truth."""

from pathlib import Path
from typing import Annotated

import typer


def evaluate(
    results: Annotated[
        list[Path],
        typer.Argument(
            help="Result folders (or trajectory files); several give mean and standard deviation."
        ),
    ],
    groundtruth: Annotated[
        str, typer.Option("--groundtruth", "-g", help="Trajectory file, folder or built-in:NAME.")
    ],
    times: Annotated[Path | None, typer.Option(help="times.txt of a KITTI ground truth.")] = None,
    frames: Annotated[
        int | None,
        typer.Option(help="Number of frames of the sequence, if there is no report.json."),
    ] = None,
    offset: Annotated[
        str,
        typer.Option(
            help="Added to the times of the poses: seconds (0.1), or frames (3f, -2f).",
            metavar="SECONDS|FRAMESf",
        ),
    ] = "",
    tracks: Annotated[
        bool, typer.Option("--tracks", help="Compare the tracks of the recording with exact depth.")
    ] = False,
    points: Annotated[
        bool, typer.Option("--map", help="Compare the map's points with exact depth.")
    ] = False,
    mesh: Annotated[
        bool,
        typer.Option(
            "--mesh", help="Compare the mesh with ground-truth depth maps at the keyframes."
        ),
    ] = False,
    scan: Annotated[
        Path | None,
        typer.Option(
            help="Compare the mesh with a scan (PLY) in the frame of the ground-truth poses."
        ),
    ] = None,
    surfels: Annotated[
        bool,
        typer.Option(
            "--surfels", help="Compare surfels with the source's depth, or with exact surfaces."
        ),
    ] = False,
    plot: Annotated[
        Path | None, typer.Option(help="Write a PNG of the error over time (needs matplotlib).")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write all figures as JSON.")] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace an existing --json or --plot.")
    ] = False,
) -> None:
    """Compare a result with ground truth: ATE under Sim(3), RPE, success rate, final and online.

    pliant eval results/room --groundtruth built-in:room --tracks --map --mesh

    pliant eval results/hall --groundtruth hall/groundtruth.txt --scan hall/laser.ply

    pliant eval results/cloth --groundtruth path/to/cloth --surfels

    pliant eval results/kitchen --groundtruth sequence/groundtruth.txt

    pliant eval results/seed-* --groundtruth sequence/groundtruth.txt
    """
    from pliant.evaluation.evaluate import EvaluationRequest, run_evaluation

    request = EvaluationRequest(
        results=results,
        groundtruth=groundtruth,
        times=times,
        frames=frames,
        offset=offset,
        tracks=tracks,
        points=points,
        mesh=mesh,
        scan=scan,
        surfels=surfels,
        plot=plot,
        json=json,
        force=force,
    )
    for line in run_evaluation(request):
        typer.echo(line)
