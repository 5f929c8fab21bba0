"""The clip of a telephone that was held upright, from the command line: run, recording, replay."""

from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
from mp4_patches import turned
from running import NO_MESH, TINY, in_this_process

import pliant as pliant_api
from pliant.datasets.builtin import builtin_folder

pytestmark = pytest.mark.system


def test_an_upright_clip_is_mapped_and_its_recording_replays_to_the_same_bytes(
    tmp_path: Path,
) -> None:
    sequence, clip = builtin_folder(TINY), tmp_path / "clip.mp4"
    upright = [cv2.imread(str(p)) for p in sorted((sequence / "images").iterdir())]
    assert upright[0] is not None
    height, width = upright[0].shape[:2]
    code = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(clip), code, 20.0, (height, width))
    for image in upright:
        assert image is not None
        writer.write(np.ascontiguousarray(np.rot90(image)))
    writer.release()
    clip.write_bytes(turned(clip.read_bytes(), 90))
    folder = tmp_path / "result"
    given = ("--calibration", sequence / "calib.yaml")
    done = in_this_process("run", clip, *given, *NO_MESH, "--output", folder)
    assert done.returncode == 0, done.stderr
    # Where nothing draws nobody is told to look on (and in test_mesh.py, without Rerun).
    assert (f"; watch live: pliant view {folder}" in done.stderr) == bool(find_spec("rerun"))
    result = pliant_api.open(folder)
    assert result.image(20).shape[:2] == (height, width)
    assert len(result.trajectory) == len(upright)
    again = ("--services", "tracking,bundle_adjustment", "--check")
    checked = in_this_process("replay", folder, *again)
    assert checked.returncode == 0, checked.stdout + checked.stderr
