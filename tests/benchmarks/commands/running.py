"""The whole pipeline: accuracy, speed, losses, memory."""

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.commands.app import Overrides, Source, Sources, app, show


@app.command()
def accuracy(
    sources: Sources,
    output: Annotated[Path, typer.Option("--output", "-o")] = Path("results/bench"),
    seeds: Annotated[int, typer.Option(help="Runs of each source, with seeds 0, 1, ...")] = 1,
    overrides: Overrides = None,
) -> None:
    """The whole pipeline through its processes: accuracy, density and frames per second.

    scripts/bench accuracy built-in:room path/to/sequence --seeds 5
    """
    from benchmarks.accuracy import measure

    show(measure(sources, output, seeds=seeds, overrides=overrides or []))


@app.command("in-process")
def in_process(
    sources: Sources,
    overrides: Overrides = None,
    seed: Annotated[int, typer.Option(help="Of the first run.")] = 0,
    seeds: Annotated[
        int, typer.Option(min=1, help="Runs of each source, with seeds after it.")
    ] = 1,
    focal: Annotated[float, typer.Option(help="Times the given focal length: a wrong one.")] = 1.0,
    off_centre: Annotated[
        float,
        typer.Option(help="Error of the given principal point, as a share of the focal length."),
    ] = 0.0,
    aspect: Annotated[float, typer.Option(help="Times the given fx alone: a wrong shape.")] = 1.0,
) -> None:
    """The rigid pipeline in one process, without services: final and online ATE.

    scripts/bench in-process path/to/tsukuba150 built-in:room --set tracking.coast_s=0
    """
    from benchmarks.in_process import measure

    show(measure(sources, overrides or [], range(seed, seed + seeds), focal, off_centre, aspect))


@app.command()
def light(sources: Sources) -> None:
    """What --light and --localise save: CPU of each service, and the final ATE.

    scripts/bench light built-in:room path/to/tum_fr1_xyz
    """
    from benchmarks.light import measure

    show(measure(sources))


@app.command("map-starts")
def map_starts(
    sources: Sources,
    overrides: Overrides = None,
    starts: Annotated[int, typer.Option(min=1, help="Places where a map begins.")] = 16,
    following: Annotated[int, typer.Option(min=2, help="Frames after that.")] = 30,
) -> None:
    """Maps begun at many places of a source: how far off they are soon after.

    scripts/bench map-starts path/to/tum_fr1_xyz --starts 32
    """
    from benchmarks.map_starts import measure

    show(measure(sources, overrides or [], starts, following))


@app.command("turned-about")
def turned_about(
    sources: Sources,
    overrides: Overrides = None,
    frames: Annotated[int, typer.Option(min=3, help="Of each part.")] = 150,
    parts: Annotated[int, typer.Option(min=1, help="Of each source.")] = 2,
) -> None:
    """Parts of sources forwards, backwards, with fewer frames, and mirrored: ATE of each.

    scripts/bench turned-about path/to/kitti_00_small1018 path/to/tsukuba150 --parts 3
    """
    from benchmarks.turned_about import measure

    show(measure(sources, overrides or [], frames, parts))


@app.command()
def losses(
    source: Source = "built-in:room",
    runs: Annotated[int, typer.Option(min=1, help="How often.")] = 20,
) -> None:
    """Run again and again at full speed: messages lost by sequence number, and equal bytes.

    scripts/bench losses built-in:room --runs 20
    """
    from benchmarks.whole_runs import losses

    show(losses(source, runs))


@app.command("recording-cost")
def recording_cost(
    source: Source = "built-in:room",
    runs: Annotated[int, typer.Option(min=1, help="Runs with and without, in turns.")] = 3,
) -> None:
    """Frames a second of the pipeline with and without a recorder.

    scripts/bench recording-cost built-in:room
    """
    from benchmarks.whole_runs import recording_cost

    show(recording_cost(source, runs))


@app.command("first-frame")
def first_frame(
    source: Source = "built-in:room",
    runs: Annotated[int, typer.Option(min=1, help="Of which the median counts.")] = 3,
) -> None:
    """From the start of `pliant run` to its first frame, kernels compiled: published, and mapped.

    scripts/bench first-frame built-in:room
    """
    from benchmarks.whole_runs import first_frame

    show(first_frame(source, runs))


@app.command("viewer-cost")
def viewer_cost(
    source: Source = "built-in:room",
    runs: Annotated[int, typer.Option(min=1, help="Of each kind, in turns.")] = 1,
) -> None:
    """Frames a second without a viewer, with one that draws, and with one that is stopped.

    scripts/bench viewer-cost built-in:room
    """
    from benchmarks.viewer_cost import measure

    show(measure(source, runs))


@app.command()
def replay(
    recording: Annotated[Path, typer.Argument(help="Result folder or recording.")],
    service: Annotated[str, typer.Option(help="Which one.")] = "tracking",
    runs: Annotated[int, typer.Option(min=1, help="Of each, in turns.")] = 3,
) -> None:
    """Frames per second of a replayed service, and of the same service on messages in memory.

    scripts/bench replay results/room --service tracking
    """
    from benchmarks.replay_rate import measure

    show(measure(recording, service, runs))


@app.command()
def latency(images: Annotated[int, typer.Option(min=50, help="To send.")] = 1000) -> None:
    """What a hop over the bus adds to a 361 kB image: TCP and mutual TLS through a router.

    scripts/bench latency
    """
    from benchmarks.latency import measure

    show(measure(images))


@app.command()
def endurance(
    source: Annotated[str, typer.Argument(help="built-in:NAME.")] = "built-in:room",
    frames: Annotated[int, typer.Option(min=1, help="At most.")] = 108_000,
    minutes: Annotated[float, typer.Option(min=0.1, help="At most.")] = 60.0,
) -> None:
    """An hour's worth of frames at full speed: memory, file handles, threads of each service.

    scripts/bench endurance built-in:room --minutes 10
    """
    from benchmarks.endurance import measure

    show(measure(source, frames, minutes))


@app.command("slow-mapping")
def slow_mapping(
    source: Annotated[str, typer.Argument(help="built-in:NAME.")] = "built-in:room",
    frames: Annotated[int, typer.Option(min=40, help="Of the source, forth and back.")] = 1200,
    fps: Annotated[float, typer.Option(min=1.0, help="Frames a second.")] = 30.0,
    slowdown: Annotated[
        float, typer.Option(min=1.0, help="Of bundle adjustment; inf: it stands still.")
    ] = 10.0,
    overrides: Overrides = None,
) -> None:
    """Live mode before, while and after bundle adjustment is slow: what tracking keeps of its rate.

    scripts/bench slow-mapping built-in:room --fps 10 --frames 400
    """
    from benchmarks.slow_mapping import measure

    show(measure(source, frames, fps, slowdown, overrides or []))


@app.command()
def growth(
    source: Annotated[str, typer.Argument(help="A hard clip; none: a built-in one.")] = "",
    calibration: Annotated[Path | None, typer.Option(help="Of its camera.")] = None,
    frames: Annotated[
        list[int] | None, typer.Option(min=10, help="Of a run; can be repeated.")
    ] = None,
    overrides: Overrides = None,
) -> None:
    """What a clip costs by its length: CPU a frame by stage, the end, keyframes, memory.

    scripts/bench growth path/to/video.mp4 --calibration calib.yaml --frames 500 --frames 1000
    """
    from benchmarks.growth import Source as Clip
    from benchmarks.growth import measure

    show(measure(Clip(source, calibration), frames or [500, 1000, 2000, 4000], overrides or []))


@app.command()
def budget(
    source: Source = "built-in:room",
    *,
    runs: Annotated[int, typer.Option(min=1, help="Of which the median counts.")] = 1,
    end: Annotated[float | None, typer.Option(min=1.0, help="Seconds of the source.")] = None,
    live: Annotated[bool, typer.Option(help="At the pace of the time stamps.")] = False,
    against: Annotated[str | None, typer.Option(help="Commit to compare with, in turns.")] = None,
    short: Annotated[bool, typer.Option(help="One line.")] = False,
    overrides: Overrides = None,
) -> None:
    """What a run costs: CPU and memory of each process, its stages, its start.

    scripts/bench budget path/to/sequence --against HEAD~1 --runs 3
    """
    from benchmarks.budget import measure

    options = ["--mode", "live"] if live else []
    options += ["--end", str(end)] if end is not None else []
    options += [word for override in overrides or [] for word in ("--set", override)]
    show(measure(source, runs, options, against, short=short))
