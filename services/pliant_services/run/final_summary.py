"""The summary of a run: where its results are, and its verdict."""

from contextlib import suppress
from pathlib import Path
from typing import Any

from pliant.recording import parts
from pliant.results.folder import PAGE_NAME, RECORDING_NAME, STATE_FOLDER, files_of
from pliant.wording import counted


def print_summary(output: Path, report: dict[str, Any]) -> None:
    """Print where the results are, and their verdict."""
    from pliant.export.export import exports_in
    from pliant.results.verdict import summary

    with suppress(BrokenPipeError):  # the results are on the disk, with or without a reader
        files = ", ".join(files_of(output, report))
        print(f"results in {output}/ ({_sizes(output)}): {files}, {_recording_in(output)}")
        print(f"open in a browser: {output / PAGE_NAME}")
        exports = ", ".join(exports_in(output))
        if exports:
            print(f"exports of the previous result: {exports}; export again with --force")
        for line in summary(report):
            print(line)


def _sizes(output: Path) -> str:
    """How much room all of a result folder takes without its checkpoints, and its recording."""
    from pliant.recording.summary import in_words

    kept = (path for path in output.rglob("*") if output / STATE_FOLDER not in path.parents)
    every = sum(path.stat().st_size for path in kept if path.is_file())
    recorded = sum(path.stat().st_size for path in parts.parts_of(output / RECORDING_NAME))
    return f"{in_words(every)}, of which the recording {in_words(recorded)}"


def _recording_in(output: Path) -> str:
    """The recording of a result folder by its name there: a file, or a folder of parts."""
    path = output / RECORDING_NAME
    if path.is_file():
        return path.name
    count = counted(len(parts.parts_of(path)), "part")
    return f"{parts.folder_of_parts(path).name}/ ({count})"
