"""A run over everything that goes wrong with a deforming scene: said, and nothing that is NaN."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from running import in_this_process

from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.datasets.builtin import builtin_folder

pytestmark = pytest.mark.system

SIZE = "width=320"
JUMP = 50
BLANK = (slice(20, 110), slice(20, 110))
HOLES = (slice(130, 220), slice(20, 110))


class Film:
    """Frames of a rendered sequence, and what is done to them on the way to a folder."""

    def __init__(self, source: Path, target: Path) -> None:
        self._source, self._target = source, target
        for kind in ("rgb", "depth"):
            (target / kind).mkdir(parents=True)
        (target / "calib.yaml").write_text((source / "calib.yaml").read_text())
        lists = {kind: (source / f"{kind}.txt").read_text() for kind in ("rgb", "depth")}
        self._files = {
            kind: [line.split()[1] for line in text.splitlines() if not line.startswith("#")]
            for kind, text in lists.items()
        }
        self._lists: dict[str, list[str]] = {"rgb": [], "depth": []}
        self.frames = 0

    def image(self, number: int) -> Any:
        return cv2.imread(str(self._source / self._files["rgb"][number]), cv2.IMREAD_GRAYSCALE)

    def depth(self, number: int) -> Any:
        return cv2.imread(str(self._source / self._files["depth"][number]), cv2.IMREAD_UNCHANGED)

    def add(self, image: Any, depth: Any = None) -> int:
        for kind, pixels in (("rgb", image), ("depth", depth)):
            if pixels is not None:
                name = f"{kind}/{self.frames:03d}.png"
                assert cv2.imwrite(str(self._target / name), pixels)
                self._lists[kind].append(f"{self.frames / 30.0:.6f} {name}\n")
                (self._target / f"{kind}.txt").write_text("".join(self._lists[kind]))
        self.frames += 1
        return self.frames - 1


def shifted(image: Any, by: int) -> Any:
    return cv2.warpAffine(image, np.array([[1.0, 0.0, by], [0.0, 1.0, 0.0]]), image.shape[::-1])


def test_a_film_in_which_everything_goes_wrong(tmp_path: Path) -> None:
    source = builtin_folder(f"built-in:sliding?frames={JUMP + 10}&{SIZE}", cache=tmp_path / "cache")
    film = Film(source, tmp_path / "film")
    small = film.add(film.image(0), film.depth(0)[::2, ::2])  # a depth map of another size
    waiting = film.add(film.image(1))  # no depth at the start
    first, depth = film.image(2), film.depth(2)
    first[BLANK], depth[HOLES] = 120, 0
    start = film.add(first, depth)
    film.add(film.image(3))
    black = film.add(np.zeros_like(first))
    back = film.add(film.image(4))
    film.add(shifted(film.image(5), 12))
    film.add(shifted(film.image(6), 24))
    leaving = film.add(shifted(film.image(6), 36))
    jump = film.add(film.image(6 + JUMP))
    flat = film.add(np.full_like(first, 90))
    again = film.add(film.image(7 + JUMP)[:, ::-1], film.depth(7 + JUMP)[:, ::-1])
    film.add(film.image(8 + JUMP)[:, ::-1])

    output = tmp_path / "result"
    done = in_this_process(
        "run", tmp_path / "film", "--profile", "deformable", "--depth-frames", "all",
        "--output", output, "--set", "surfels.max_surfels=120",
    )  # fmt: skip
    assert done.returncode in (0, 3), done.stderr
    assert "Traceback" not in done.stderr
    assert "expected 320x240" in done.stdout
    assert "tracking was lost" in done.stdout
    report = json.loads((output / "report.json").read_text())
    assert report["frames"] == film.frames
    assert report["verdict"] in ("doubtful", "bad")
    assert done.stdout.splitlines()[-1] == f"{report['verdict']}: {report['verdict_reason']}"
    assert list(report["notes"]) == [str(small)]
    assert report["alive_per_frame"][: waiting + 1] == [0, 0]
    assert {black, flat} <= set(report["frames_lost"])
    assert not {start, back, again} & set(report["frames_lost"])
    assert [s["first_frame"] for s in report["segments"]] == [start, again]
    with np.load(output / "surfels.npz") as surfels:
        for name in surfels.files:
            assert np.isfinite(surfels[name]).all(), name
        rows = np.split(np.arange(len(surfels["ids"])), np.cumsum(surfels["counts"])[:-1])
        state, points = surfels["state"], surfels["points_px"]
        for region in (BLANK, HOLES):  # nothing is born without texture or without depth
            inside = [
                (points[rows[start], axis] > span.start) & (points[rows[start], axis] < span.stop)
                for axis, span in ((1, region[0]), (0, region[1]))
            ]
            assert not (inside[0] & inside[1]).any()
        assert (state[rows[black]] != SurfelState.TRACKED).all()
        assert (state[rows[back]] == SurfelState.TRACKED).mean() > 0.8
        assert (state[rows[leaving]] == SurfelState.OUTSIDE).any()
        assert len(rows[jump]) == len(rows[start])
        moved = np.linalg.norm(surfels["positions"][rows[jump]], axis=1)
        assert (moved < 10.0).all()
        assert not set(surfels["ids"][rows[again]]) & set(surfels["ids"][rows[flat]])
