"""The mesh of a run with a texture from its keyframes, as glTF or OBJ."""

from pathlib import Path

from pliant.algorithms.meshing.mesh_components import cleaned
from pliant.errors import ResultError
from pliant.export.crop import Box, cropped_mesh
from pliant.export.images import make_folder
from pliant.formats.textured import TexturedMesh, write_glb, write_obj
from pliant.messages import topics
from pliant.messages.types import MeshPiece
from pliant.recording.reader import Recording
from pliant.results.mesh_files import mesh_of
from pliant.results.run import read_run
from pliant.results.textured_mesh import textured

TRIANGLES = 40_000
"""The default number of triangles of a decimated mesh."""
_TEXELS = 2048


def glb(
    recording: Recording, path: Path, folder: Path | None, triangles: int = TRIANGLES,
    clean: bool = False, observed: bool = False, crop: Box | None = None,
) -> None:  # fmt: skip
    """Binary glTF with the texture inside."""
    mesh = textured_mesh(recording, triangles, clean=clean, observed=observed, crop=crop)
    write_glb(path, mesh)


def obj(
    recording: Recording, path: Path, folder: Path | None, triangles: int = TRIANGLES,
    clean: bool = False, observed: bool = False, crop: Box | None = None,
) -> None:  # fmt: skip
    """A folder with ``mesh.obj``, ``mesh.mtl`` and ``mesh.png``."""
    mesh = textured_mesh(recording, triangles, clean=clean, observed=observed, crop=crop)
    make_folder(path)
    write_obj(path, mesh)


def textured_mesh(
    recording: Recording, triangles: int, *, clean: bool = False, observed: bool = False,
    crop: Box | None = None,
) -> TexturedMesh:  # fmt: skip
    """The fine mesh of the longest segment, of at most that many triangles.

    clean: without small pieces.    observed: without closed holes.    crop: only what lies in this
    box.

    Raises ResultError if there is none.
    """
    run = read_run(recording.path)
    segment = run.history.longest_segment()
    pieces = [p for p in recording.decoded(topics.MESH_FINAL) if isinstance(p, MeshPiece)]
    fine = mesh_of(pieces, segment)
    if run.stream is None or fine is None or not len(fine.triangles):
        raise ResultError(f"{recording.path}: has no mesh: run its source again")
    fine = cropped_mesh(fine.observed() if observed else fine, crop)
    fine = cleaned(fine) if clean else fine
    return textured(fine, recording, run, run.stream, segment, triangles=triangles, texels=_TEXELS)
