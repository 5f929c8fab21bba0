"""Images and recordings: bytes, speed, kills, and the reference that is kept."""

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.commands.app import Overrides, Sources, app, show


@app.command()
def codec() -> None:
    """Packing and unpacking an image.

    scripts/bench codec
    """
    from benchmarks.codec import measure

    show(measure())


@app.command()
def clip(
    video: Annotated[Path | None, typer.Argument(help="A video [the built-in room].")] = None,
) -> None:
    """What the images of a video take in a recording, and how quickly they are there again.

    scripts/bench clip
    """
    from benchmarks.clip import measure

    show(measure(video))


@app.command("phone-clip")
def phone_clip(
    sources: Sources,
    seconds: Annotated[float, typer.Option(min=1.0, help="Length of the clip.")] = 15.0,
    keep: Annotated[Path | None, typer.Option(help="Folder for clips and results.")] = None,
) -> None:
    """Clips like a phone's, 1920x1080, through `pliant run` without a calibration.

    scripts/bench phone-clip path/to/tum_fr1_xyz
    """
    from benchmarks.phone_clip import measure

    show(measure(sources, seconds, keep))


@app.command("recording-bytes")
def recording_bytes(
    source: Annotated[
        str, typer.Argument(help="A video, a recording, or what becomes a video.")
    ] = "built-in:room?colour=0",
    frames: Annotated[int | None, typer.Option(min=2, help="First frames of the video.")] = None,
    width: Annotated[int | None, typer.Option(min=64, help="Enlarge them to this many px.")] = None,
    overrides: Overrides = None,
) -> None:
    """What the recording of a video takes, by topic and field, and how many times the video.

    scripts/bench recording-bytes clip.mp4

    scripts/bench recording-bytes path/to/tum_fr1_xyz --frames 450 --width 1440
    """
    from benchmarks.recording_bytes import measure

    show(measure(source, frames, width, overrides or []))


@app.command()
def recording(
    seconds: Annotated[int, typer.Option(help="Length of the recording that is made.")] = 600,
) -> None:
    """Writing, reading, seeking and keeping up.  Ten minutes of recording take 12 GB for a while.

    scripts/bench recording
    """
    from benchmarks.recording import measure

    show(measure(seconds))


@app.command()
def compression(recording: Annotated[Path, typer.Argument(help="A recording.")]) -> None:
    """What each topic of a recording gains from compression, and at which speed.

    scripts/bench compression results/room/recording.mcap
    """
    from benchmarks.recording import compression

    show(compression(recording))


@app.command()
def recorder(kills: Annotated[int, typer.Option(help="How often.")] = 50) -> None:
    """kill -9 of the recorder at random moments, and what recovery keeps.

    scripts/bench recorder --kills 50
    """
    from benchmarks.recorder_kills import measure

    show(measure(kills))


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
    show(changed or ["nothing has changed"])
    if refresh:
        version = kept.keep_version(folder.parent / "recordings", folder / kept.INPUT)
        show([f"a recording of this version: {version}"] if version else [])
        kept.write_table(Path("docs/architecture.md"), folder)
    show([kept.table(folder)])
    if changed and not refresh:
        raise typer.Exit(1)
