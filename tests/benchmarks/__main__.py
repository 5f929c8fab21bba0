"""``scripts/bench``: measure, and compare within one run."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from pliant_services.cli import main

app = typer.Typer(
    name="scripts/bench",
    pretty_exceptions_enable=False,
    add_completion=False,
    no_args_is_help=True,
    help="Measure speed and accuracy.  Every figure in the docs names the command that made it.",
)

Sources = Annotated[list[str], typer.Argument(help="Folders or built-in:NAME.")]
Overrides = Annotated[list[str] | None, typer.Option("--set", help="KEY=VALUE; may be repeated.")]


@app.command()
def tracking(
    source: Annotated[str, typer.Argument(help="Folder or built-in:NAME.")] = "built-in:room",
    frames: Annotated[int, typer.Option(help="Frames to measure.")] = 100,
    overrides: Overrides = None,
) -> None:
    """Tracking per stage, beside OpenCV's pyramidal LK for the same points.

    scripts/bench tracking built-in:room
    """
    from benchmarks.tracking import measure
    from pliant.config import load_config

    _print(measure(source, load_config(None, overrides or []), frames))


@app.command()
def places(sources: Sources, overrides: Overrides = None) -> None:
    """How often the place of a frame is recognised, in its own map and in those of the others.

    scripts/bench places built-in:room built-in:tabletop
    """
    from benchmarks.places import measure
    from pliant.config import load_config

    _print(measure(sources, load_config(None, overrides or [])))


@app.command()
def deceiving(
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each scene.")] = 5,
    only: Annotated[str, typer.Option(help="Scenes whose names have this.")] = "",
    overrides: Overrides = None,
) -> None:
    """Rendered scenes that look the same in more than one place: is one ever taken for another?

    scripts/bench deceiving --seeds 5
    """
    from benchmarks.deceiving import measure
    from pliant.config import load_config

    _print(measure(load_config(None, overrides or []), seeds, only))


@app.command()
def rough(
    folder: Annotated[Path, typer.Argument(help="Folder of sequences with a ground truth.")],
    only: Annotated[
        list[str] | None, typer.Option("--only", help="Cases whose names have this.")
    ] = None,
    overrides: Overrides = None,
) -> None:
    """Dark, blurred, covered and few frames, things that move, turns: is the camera followed?

    scripts/bench rough ../shared/data/rigid --only black
    """
    from benchmarks.rough import measure
    from pliant.config import load_config

    _print(measure(folder, load_config(None, overrides or []), only or []))


@app.command("kept-maps")
def kept_maps(sources: Sources, overrides: Overrides = None) -> None:
    """Sources cut in two: the second half localised in the map of the first, and going on in it.

    scripts/bench kept-maps path/to/7scenes_redkitchen400 built-in:room
    """
    from benchmarks.kept_maps import measure
    from pliant.config import load_config

    _print(measure(sources, load_config(None, overrides or [])))


@app.command("changed-places")
def changed_places(
    seeds: Annotated[int, typer.Option(min=1, help="Rooms.")] = 3, overrides: Overrides = None
) -> None:
    """How often rendered rooms are recognised: darker, exposed otherwise, rearranged, from afar.

    scripts/bench changed-places --seeds 3
    """
    from benchmarks.changed_places import measure
    from pliant.config import load_config

    _print(measure(load_config(None, overrides or []), seeds))


@app.command()
def sessions(sources: Sources, overrides: Overrides = None) -> None:
    """Sources forth and back, whole and as two sessions with the dark between them.

    scripts/bench sessions path/to/7scenes_redkitchen400 built-in:corridor
    """
    from benchmarks.sessions import measure
    from pliant.config import load_config

    _print(measure(sources, load_config(None, overrides or [])))


@app.command()
def kidnappings(sources: Sources, overrides: Overrides = None) -> None:
    """Sources whose camera is carried off ten times, in the dark and from image to image.

    scripts/bench kidnappings built-in:room path/to/7scenes_redkitchen400
    """
    from benchmarks.sessions import kidnappings as measure
    from pliant.config import load_config

    _print(measure(sources, load_config(None, overrides or [])))


@app.command("merged-maps")
def merged_maps(sources: Sources, overrides: Overrides = None) -> None:
    """Two sessions whose frames overlap by a fifth, and their maps merged into one.

    scripts/bench merged-maps path/to/7scenes_redkitchen400 built-in:room
    """
    from benchmarks.merged_maps import measure
    from pliant.config import load_config

    _print(measure(sources, load_config(None, overrides or [])))


@app.command("without-places")
def without_places(
    sources: Sources,
    lit: Annotated[bool, typer.Option(help="As they are.")] = True,
    cut: Annotated[bool, typer.Option(help="And with the dark in the middle.")] = True,
    overrides: Overrides = None,
) -> None:
    """Sources with and without places, as they are and with two seconds in the dark.

    scripts/bench without-places path/to/7scenes_redkitchen400 built-in:court
    """
    from benchmarks.without_places import measure
    from pliant.config import load_config

    _print(measure(sources, load_config(None, overrides or []), lit=lit, cut=cut))


@app.command("unknown-lens")
def unknown_lens(
    sources: Sources,
    frames: Annotated[int | None, typer.Option(min=2, help="First frames [all].")] = None,
    overrides: Overrides = None,
) -> None:
    """Sources without a calibration and with wrong ones: the lens that is found, and the error.

    scripts/bench unknown-lens path/to/tsukuba150 built-in:room --frames 200
    """
    from benchmarks.unknown_lens import measure

    _print(measure(sources, frames, overrides or []))


@app.command("any-size")
def any_size(
    sources: Sources,
    sizes: Annotated[list[str], typer.Option("--size", help="WIDTHxHEIGHT; may be repeated.")],
    frames: Annotated[int, typer.Option(min=2, help="First frames.")] = 60,
    overrides: Overrides = None,
) -> None:
    """The same frames at several sizes, rendered, enlarged or made smaller: the map of each.

    scripts/bench any-size built-in:room --size 320x240 --size 640x480 --size 1920x1440
    """
    from benchmarks.any_size import measure

    _print(measure(sources, sizes, frames, overrides or []))


@app.command("surfel-speed")
def surfel_speed(
    source: Annotated[
        str | None, typer.Argument(help="Folder with depth, or built-in:NAME.  Default: a board.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, help="Frames to measure.")] = 17,
    surfels: Annotated[int, typer.Option(min=8, help="Most surfels.")] = 500,
) -> None:
    """Surfels per stage, beside OpenCV's pyramidal LK for the same points.

    scripts/bench surfel-speed path/to/cloth
    """
    from benchmarks.surfel_speed import measure

    _print(measure(source, frames, surfels))


@app.command("exported-models")
def exported_models(
    results: Annotated[list[Path], typer.Argument(help="Result folders of runs.")],
) -> None:
    """COLMAP models of runs beside COLMAP's own of the same images: held-out reprojection.

    scripts/bench exported-models results/room
    """
    from benchmarks.exported_models import measure

    _print(measure(results))


@app.command()
def colmap(
    sources: Annotated[list[str], typer.Argument(help="Sequences with a ground truth.")],
) -> None:
    """The same clip through COLMAP and through Pliant: time, ATE, points.

    scripts/bench colmap path/to/tsukuba150 built-in:room
    """
    from benchmarks.colmap import measure

    _print(measure(sources))


@app.command("drone-flights")
def drone_flights(
    motions: Annotated[Path, typer.Argument(help="Folder of TUM files: EuRoC's true motions.")],
    only: Annotated[
        list[str] | None, typer.Option("--only", help="Names of flights; may be repeated.")
    ] = None,
    frames: Annotated[int | None, typer.Option(min=2, help="First frames of each only.")] = None,
    overrides: Overrides = None,
) -> None:
    """EuRoC's motions through a rendered hall and room.  All eleven take two hours.

    scripts/bench drone-flights euroc_gt_leftcam --only V102
    """
    from benchmarks.drone_flights import measure

    _print(measure(motions, only=only or [], frames=frames, overrides=overrides or []))


@app.command()
def codec() -> None:
    """Packing and unpacking an image.

    scripts/bench codec
    """
    from benchmarks.codec import measure

    _print(measure())


@app.command()
def clip(
    video: Annotated[Path | None, typer.Argument(help="A video [the built-in room].")] = None,
) -> None:
    """What the images of a video take in a recording, and how quickly they are there again.

    scripts/bench clip
    """
    from benchmarks.clip import measure

    _print(measure(video))


@app.command("phone-clip")
def phone_clip(
    sources: Sources,
    seconds: Annotated[float, typer.Option(min=1.0, help="Length of the clip.")] = 15.0,
    keep: Annotated[Path | None, typer.Option(help="Folder for clips and results.")] = None,
) -> None:
    """Clips like a telephone's, 1920x1080, through `pliant run` without a calibration.

    scripts/bench phone-clip path/to/tum_fr1_xyz
    """
    from benchmarks.phone_clip import measure

    _print(measure(sources, seconds, keep))


@app.command("recording-bytes")
def recording_bytes(
    source: Annotated[
        str, typer.Argument(help="A video, a recording, or what becomes a video.")
    ] = "built-in:room?colour=0",
    frames: Annotated[int | None, typer.Option(min=2, help="First frames of the video.")] = None,
    width: Annotated[int | None, typer.Option(min=64, help="Enlarge them to so many px.")] = None,
    overrides: Overrides = None,
) -> None:
    """What the recording of a video takes, by topic and field, and how many times the video.

    scripts/bench recording-bytes clip.mp4

    scripts/bench recording-bytes path/to/tum_fr1_xyz --frames 450 --width 1440
    """
    from benchmarks.recording_bytes import measure

    _print(measure(source, frames, width, overrides or []))


@app.command()
def recording(
    seconds: Annotated[int, typer.Option(help="Length of the recording that is made.")] = 600,
) -> None:
    """Writing, reading, seeking and keeping up.  Ten minutes of recording take 12 GB for a while.

    scripts/bench recording
    """
    from benchmarks.recording import measure

    _print(measure(seconds))


@app.command()
def compression(recording: Annotated[Path, typer.Argument(help="A recording.")]) -> None:
    """What each topic of a recording gains from compression, and at which speed.

    scripts/bench compression results/room/recording.mcap
    """
    from benchmarks.recording import compression

    _print(compression(recording))


@app.command()
def recorder(kills: Annotated[int, typer.Option(help="How often.")] = 50) -> None:
    """kill -9 of the recorder at random moments, and what recovery keeps.

    scripts/bench recorder --kills 50
    """
    from benchmarks.recorder_kills import measure

    _print(measure(kills))


@app.command()
def reference(
    folder: Annotated[Path, typer.Option(help="Where it is kept.")] = Path("tests/data/reference"),
    refresh: Annotated[
        bool, typer.Option("--refresh", help="Keep what the services make now.")
    ] = False,
) -> None:
    """Replay the reference recording and compare; exit 1 where it differs.  And what is kept of it.

    scripts/bench reference --refresh
    """
    import reference as kept

    changed = kept.refresh(folder) if refresh else kept.check(folder)
    _print(changed or ["nothing has changed"])
    if refresh:
        version = kept.keep_version(folder.parent / "recordings", folder / kept.INPUT)
        _print([f"a recording of this version: {version}"] if version else [])
        kept.write_table(Path("docs/architecture.md"), folder)
    _print([kept.table(folder)])
    if changed and not refresh:
        raise typer.Exit(1)


@app.command()
def bundle(
    folder: Annotated[
        Path | None, typer.Option("--problems", help="Folder of BAL and libmv problems.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG of the cost over time.")] = None,
) -> None:
    """Bundle adjustment beside Ceres (pyceres) and scipy: time to the same cost.  Ten minutes.

    scripts/bench bundle --problems bundle_adjustment
    """
    from benchmarks.bundle import measure

    _print(measure(folder, plot))


@app.command("map-sizes")
def map_sizes(
    keyframes: Annotated[list[int], typer.Argument(min=10, help="Numbers of keyframes.")],
    points: Annotated[int, typer.Option(min=1, help="New ones in each keyframe.")] = 300,
    seen: Annotated[int, typer.Option(min=2, help="Keyframes that see each.")] = 10,
) -> None:
    """The final adjustment of synthetic maps: CPU time and memory, by their size.

    scripts/bench map-sizes 200 400 1000 3000
    """
    from benchmarks.map_sizes import measure

    _print(measure(keyframes, points, seen))


@app.command("mesh-parts")
def mesh_parts(
    vertices: Annotated[int, typer.Option(min=100, help="Of the keyframe.")] = 10_000,
    repeats: Annotated[int, typer.Option(min=1, help="Of each part; the least counts.")] = 10,
    seeds: Annotated[int, typer.Option(min=1, help="Scenes for the errors.")] = 8,
) -> None:
    """The parts of meshing on a synthetic keyframe, beside the paper's, and what NLTGV gains.

    scripts/bench mesh-parts
    """
    from benchmarks.mesh_parts import measure

    _print(measure(vertices, repeats, seeds))


@app.command()
def images(
    source: Annotated[str, typer.Argument(help="Folder or built-in:NAME.")] = "built-in:room",
    frames: Annotated[int, typer.Option(min=1, help="Frames to measure.")] = 12,
) -> None:
    """Images for a link between machines: how small, and what that costs on either side.

    scripts/bench images path/to/sequence
    """
    from benchmarks.images import measure

    _print(measure(source, frames))


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

    _print(measure(sources, output, seeds=seeds, overrides=overrides or []))


@app.command("in-process")
def in_process(
    sources: Sources,
    overrides: Overrides = None,
    seed: Annotated[int, typer.Option(help="Of the first run.")] = 0,
    seeds: Annotated[
        int, typer.Option(min=1, help="Runs of each source, with seeds after it.")
    ] = 1,
    focal: Annotated[float, typer.Option(help="Times the given focal length: a wrong one.")] = 1.0,
) -> None:
    """The rigid pipeline in one process, without services: final and causal ATE.

    scripts/bench in-process path/to/tsukuba150 built-in:room --set tracking.turn_patches=false
    """
    from benchmarks.in_process import measure

    _print(measure(sources, overrides or [], range(seed, seed + seeds), focal))


@app.command()
def losses(
    source: Annotated[str, typer.Argument(help="Folder or built-in:NAME.")] = "built-in:room",
    runs: Annotated[int, typer.Option(min=1, help="How often.")] = 20,
) -> None:
    """Run again and again at full speed: messages lost by sequence number, and equal bytes.

    scripts/bench losses built-in:room --runs 20
    """
    from benchmarks.whole_runs import losses

    _print(losses(source, runs))


@app.command("recording-cost")
def recording_cost(
    source: Annotated[str, typer.Argument(help="Folder or built-in:NAME.")] = "built-in:room",
    runs: Annotated[int, typer.Option(min=1, help="Runs with and without, in turns.")] = 3,
) -> None:
    """Frames a second of the pipeline with and without a recorder.

    scripts/bench recording-cost built-in:room
    """
    from benchmarks.whole_runs import recording_cost

    _print(recording_cost(source, runs))


@app.command("viewer-cost")
def viewer_cost(
    source: Annotated[str, typer.Argument(help="Folder or built-in:NAME.")] = "built-in:room",
    runs: Annotated[int, typer.Option(min=1, help="Of each kind, in turns.")] = 1,
) -> None:
    """Frames a second without a viewer, with one that draws, and with one that is stopped.

    scripts/bench viewer-cost built-in:room
    """
    from benchmarks.viewer_cost import measure

    _print(measure(source, runs))


@app.command()
def replay(
    recording: Annotated[Path, typer.Argument(help="Result folder or recording.")],
    service: Annotated[str, typer.Option(help="Which one.")] = "tracking",
    runs: Annotated[int, typer.Option(min=1, help="Of each, in turns.")] = 3,
) -> None:
    """Frames a second of a replayed service, beside the same service on messages in memory.

    scripts/bench replay results/room --service tracking
    """
    from benchmarks.replay_rate import measure

    _print(measure(recording, service, runs))


@app.command()
def kills(
    source: Annotated[str, typer.Argument(help="Of 300 frames.")] = "built-in:room",
    count: Annotated[int, typer.Option(min=1, help="How often each.")] = 20,
    seed: Annotated[int, typer.Option(help="Chooses the moments.")] = 0,
) -> None:
    """kill -9 of each service, and of all at once, at random moments: are the results the same?

    scripts/bench kills built-in:room --count 20
    """
    from benchmarks.whole_runs import kills

    _print(kills(source, count, seed))


@app.command()
def latency(images: Annotated[int, typer.Option(min=50, help="To send.")] = 1000) -> None:
    """What a hop over the bus adds to a 361 kB image: TCP and mutual TLS through a router.

    scripts/bench latency
    """
    from benchmarks.latency import measure

    _print(measure(images))


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

    _print(measure(source, frames, minutes))


@app.command("slow-mapping")
def slow_mapping(
    source: Annotated[str, typer.Argument(help="built-in:NAME.")] = "built-in:room",
    frames: Annotated[int, typer.Option(min=40, help="Of the source, forth and back.")] = 1200,
    fps: Annotated[float, typer.Option(min=1.0, help="Frames a second.")] = 30.0,
    slowdown: Annotated[float, typer.Option(min=1.0, help="Of bundle adjustment.")] = 10.0,
    overrides: Overrides = None,
) -> None:
    """Live mode before, while and after bundle adjustment is slow: what tracking keeps of its rate.

    scripts/bench slow-mapping built-in:room --fps 10 --frames 400
    """
    from benchmarks.slow_mapping import measure

    _print(measure(source, frames, fps, slowdown, overrides or []))


@app.command()
def ablation(sources: Sources) -> None:
    """What each addition to the paper is worth.

    scripts/bench ablation built-in:room path/to/sequence
    """
    from benchmarks.ablation import measure

    _print(measure(sources))


@app.command()
def mesh(
    result: Annotated[Path, typer.Argument(help="Result folder of a run.")],
    groundtruth: Annotated[
        str, typer.Option("--groundtruth", "-g", help="Folder with depth maps, or built-in:NAME.")
    ],
    overrides: Overrides = None,
) -> None:
    """Meshes of one run: NLTGV, Laplacian, no smoothing, Poisson, against true depth.

    scripts/bench mesh results/room --groundtruth built-in:room
    """
    from benchmarks.mesh import measure

    _print(measure(result, groundtruth, overrides or []))


@app.command("mesh-live")
def mesh_live(
    result: Annotated[Path, typer.Argument(help="Result folder of a run.")],
    groundtruth: Annotated[
        str, typer.Option("--groundtruth", "-g", help="Folder with depth maps, or built-in:NAME.")
    ],
    overrides: Overrides = None,
) -> None:
    """The live mesh with and without following the corrections of the map, against true depth.

    scripts/bench mesh-live results/court --groundtruth built-in:court
    """
    from benchmarks.mesh import measure_live

    _print(measure_live(result, groundtruth, overrides or []))


@app.command()
def surfels(
    sources: Annotated[
        list[str] | None, typer.Argument(help="Instead of the tables' own sequences.")
    ] = None,
    tracks: Annotated[
        str | None, typer.Option(help="mdh_23frames_301pts.npz of the Kinect paper.")
    ] = None,
    tables: Annotated[
        str,
        typer.Option(help="targets,models,sizes,scales,cameras,neighbours,troubles,limits,losses"),
    ] = "",
    frames: Annotated[int, typer.Option(min=2, help="Of each sequence.")] = 60,
    count: Annotated[int, typer.Option("--surfels", min=8, help="At most.")] = 200,
    quick: Annotated[bool, typer.Option("--quick", help="A few rows of each table.")] = False,
) -> None:
    """Surfels on deforming sequences with exact truth: models, sizes, scales, cameras, troubles.

    scripts/bench surfels --tracks kinect_paper_tracks/mdh_23frames_301pts.npz

    scripts/bench surfels --quick

    scripts/bench surfels path/to/cloth "built-in:sliding?light=0.5" --tables models,sizes
    """
    from benchmarks.surfels import measure

    chosen = [name for name in tables.split(",") if name]
    lines = measure(
        sources or [], tracks=tracks, tables=chosen, frames=frames, surfels=count, quick=quick
    )
    _print(lines)


@app.command("how-pictures")
def how_pictures(
    rigid: Annotated[Path, typer.Argument(help="Result folder of built-in:room.")],
    deforming: Annotated[Path, typer.Argument(help="And of built-in:objects?frames=90.")],
    output: Annotated[Path, typer.Option("--output", "-o")] = Path("docs/how"),
) -> None:
    """The pictures of docs/how.md: extrema, flow, depth, map and surfels.

    scripts/bench how-pictures results/room results/objects
    """
    from benchmarks.how_pictures import draw

    _print(draw(rigid, deforming, output))


def _print(lines: Iterable[str]) -> None:
    for line in lines:
        typer.echo(line)


if __name__ == "__main__":
    main(app)
