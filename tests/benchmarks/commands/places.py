"""Whether the camera is followed, and places are recognised."""

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.commands.app import Overrides, Source, Sources, app, show


@app.command()
def tracking(
    source: Source = "built-in:room",
    frames: Annotated[int, typer.Option(help="Frames to measure.")] = 100,
    overrides: Overrides = None,
) -> None:
    """Tracking per stage, compared with OpenCV's pyramidal LK for the same points.

    scripts/bench tracking built-in:room
    """
    from benchmarks.tracking import measure
    from pliant.config import load_config

    show(measure(source, load_config(None, overrides or []), frames))


@app.command()
def places(sources: Sources, overrides: Overrides = None) -> None:
    """How often the place of a frame is recognised, in its own map and in those of the others.

    scripts/bench places built-in:room built-in:tabletop
    """
    from benchmarks.places import measure
    from pliant.config import load_config

    show(measure(sources, load_config(None, overrides or [])))


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

    show(measure(load_config(None, overrides or []), seeds, only))


@app.command()
def second_pass(
    sources: Sources,
    frames: Annotated[int | None, typer.Option(help="The first frames [all].")] = None,
    calibration: Annotated[Path | None, typer.Option(help="Of a video.")] = None,
    overrides: Overrides = None,
) -> None:
    """What `--quality high` recovers, and its cost, in this process.

    scripts/bench second-pass path/to/tum_fr1_rpy_first360 --set seed=1
    """
    from benchmarks.second_pass import measure
    from pliant.config import load_config

    found = measure(
        sources, load_config(None, overrides or []), frames=frames, calibration=calibration
    )
    show(found)


@app.command()
def rough(
    folder: Annotated[Path, typer.Argument(help="Folder of sequences with a ground truth.")],
    only: Annotated[
        list[str] | None, typer.Option("--only", help="Cases whose names have this.")
    ] = None,
    overrides: Overrides = None,
) -> None:
    """Dark, blurred, covered and few frames, things that move, turns: is the camera followed?

    scripts/bench rough ../shared/data/rigid --only dark
    """
    from benchmarks.rough import measure
    from pliant.config import load_config

    show(measure(folder, load_config(None, overrides or []), only or []))


@app.command()
def zoom(
    folder: Annotated[Path, typer.Argument(help="Folder of sequences with a ground truth.")],
    only: Annotated[
        list[str] | None, typer.Option("--only", help="Cases whose names have this.")
    ] = None,
    overrides: Overrides = None,
) -> None:
    """Focus breathing, zoom and electronic stabilisation: is the map right, or flagged?

    scripts/bench zoom ../shared/data/rigid --only tum_fr1_xyz
    """
    from benchmarks.zoom import measure
    from pliant.config import load_config

    show(measure(folder, load_config(None, overrides or []), only or []))


@app.command("kept-maps")
def kept_maps(sources: Sources, overrides: Overrides = None) -> None:
    """Sources cut in two: the second half localised in the map of the first, and extending it.

    scripts/bench kept-maps path/to/7scenes_redkitchen400 built-in:room
    """
    from benchmarks.kept_maps import measure
    from pliant.config import load_config

    show(measure(sources, load_config(None, overrides or [])))


@app.command("changed-places")
def changed_places(
    seeds: Annotated[int, typer.Option(min=1, help="Rooms.")] = 3, overrides: Overrides = None
) -> None:
    """How often rendered rooms are recognised: darker, exposed otherwise, rearranged, from afar.

    scripts/bench changed-places --seeds 3
    """
    from benchmarks.changed_places import measure
    from pliant.config import load_config

    show(measure(load_config(None, overrides or []), seeds))


@app.command()
def sessions(sources: Sources, overrides: Overrides = None) -> None:
    """Sources forth and back, whole and as two sessions with the dark between them.

    scripts/bench sessions path/to/7scenes_redkitchen400 built-in:corridor
    """
    from benchmarks.sessions import measure
    from pliant.config import load_config

    show(measure(sources, load_config(None, overrides or [])))


@app.command()
def kidnappings(sources: Sources, overrides: Overrides = None) -> None:
    """Sources whose camera is relocated ten times, in the dark and by a cut.

    scripts/bench kidnappings built-in:room path/to/7scenes_redkitchen400
    """
    from benchmarks.sessions import kidnappings as measure
    from pliant.config import load_config

    show(measure(sources, load_config(None, overrides or [])))


@app.command("merged-maps")
def merged_maps(sources: Sources, overrides: Overrides = None) -> None:
    """Two sessions whose frames overlap by a fifth, and their maps merged into one.

    scripts/bench merged-maps path/to/7scenes_redkitchen400 built-in:room
    """
    from benchmarks.merged_maps import measure
    from pliant.config import load_config

    show(measure(sources, load_config(None, overrides or [])))


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

    show(measure(sources, load_config(None, overrides or []), lit=lit, cut=cut))


@app.command("street-block")
def street_block(
    folder: Annotated[Path, typer.Argument(help="Folder to make.")],
    frames: Annotated[int | None, typer.Option(min=2, help="First frames only.")] = None,
    fps: Annotated[float, typer.Option(min=1.0, help="Frames a second.")] = 30.0,
    block: Annotated[
        tuple[float, float], typer.Option(help="Half the extent of the block, metres.")
    ] = (20.0, 15.0),
) -> None:
    """Render a ride of 203 m about a block of houses, out of doors: 150 s of CPU.

    scripts/bench street-block results/street-block
    """
    from benchmarks.street_block import CAMERA, render

    camera = CAMERA.model_copy(update={"fps": fps})
    render(folder, frames=frames, camera=camera, block_m=block)


@app.command()
def loops(sources: Sources, overrides: Overrides = None) -> None:
    """Sources that end where they began: what drift is left there, with and without places.

    scripts/bench loops results/street-block built-in:court
    """
    from benchmarks.loops import measure
    from pliant.config import load_config

    show(measure(sources, load_config(None, overrides or [])))
